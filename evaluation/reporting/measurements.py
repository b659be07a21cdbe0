"""The results of all runs, each with its run and the training of its model; their comparisons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

from conf.errors import UserError
from data.records import SelectionItem
from evaluation.metrics.results import UNTRAINED, RetrievalResult, SelectionResult
from evaluation.metrics.significance import PairedComparison, compare_runs
from evaluation.reporting.run_responses import Responses
from evaluation.reporting.runs import FinishedRun, training_settings

TRANSFER_SUITES = {"movi_a": "MoVi-A", "physion": "Physion"}
"""The paper's transfer suites by their simulator."""
REGIMES = {
    "answer_only": "answer-only",
    "cot": "full student",
    "cot_no_candidate_analysis": "- candidate analysis",
    "cot_no_match_layout": "- match layout",
}
"""The paper's names of the training regimes."""
ABLATED_REGIMES = ("cot_no_candidate_analysis", "cot_no_match_layout")
"""The regimes without a part of the rationale."""


@dataclass(frozen=True)
class Measurement:
    """A result with its run and the training of its model.

    Attributes:
        name: Name of the model in the report, which may differ from the name in its run.
        training: Settings of the training run; None for a released model, empty if unknown.
    """

    result: SelectionResult | RetrievalResult
    run: FinishedRun
    name: str
    training: dict[str, Any] | None

    @property
    def benchmark(self) -> str:
        return self.result.benchmark

    @property
    def variants(self) -> list[str]:
        """The suite and the control of its items; empty for the benchmark's unchanged items."""
        if isinstance(self.result, RetrievalResult):
            return []
        return [x for x in (self.result.suite, self.result.control) if x is not None]

    @property
    def items(self) -> str:
        """The name of its item set: benchmark, suite and control."""
        return ", ".join([self.benchmark, *self.variants])

    @property
    def trained(self) -> bool:
        return self.training is not None

    @property
    def regime(self) -> str | None:
        return (self.training or {}).get("train", {}).get("regime")

    @property
    def training_benchmark(self) -> str | None:
        """The benchmark that the model was trained on, if known."""
        return (self.training or {}).get("benchmark", {}).get("name")

    @property
    def base(self) -> str | None:
        """The base of a student, or the released model itself."""
        settings = self.run.config if self.training is None else self.training
        return settings.get("student", {}).get("name")

    @property
    def seed(self) -> int | None:
        """The seed of the training."""
        return (self.training or {}).get("seed")

    @property
    def label(self) -> str:
        return f"{self.name} ({self.result.mode})"

    @property
    def is_transfer_suite(self) -> bool:
        """Whether its items are of a transfer suite or of its stand-in."""
        benchmark = self.run.config.get("benchmark", {})
        return bool({benchmark.get("simulator"), benchmark.get("standin")} & {*TRANSFER_SUITES})

    @property
    def line(self) -> tuple:
        """Identifies the line of a table: results with equal lines have equal names."""
        of = self.result
        variant = of.mode if isinstance(of, SelectionResult) else (of.width, of.builder)
        return self.run.kind, self.items, of.name, variant


def read_measurements(
    runs: Iterable[FinishedRun], root: Path, kinds: Sequence[str]
) -> list[Measurement]:
    """Return the results of the runs of some kinds below `root`."""
    measurements = []
    for run in runs:
        if run.kind in kinds:
            training = training_settings(run, root)
            for row in run.report.rows:
                # A trained retriever's report also has rows of its untrained base.
                trained = None if row.name.startswith(UNTRAINED) else training
                measurements.append(Measurement(row, run, row.name, trained))
    return measurements


def deduplicate(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return each result once: reports of several retrievers repeat the row of a common base.

    Models of one name with different results are named after their runs, too.
    """
    kept: list[Measurement] = []
    for m in measurements:
        if all(m.result != other.result for other in kept):
            kept.append(m)
    counts = Counter(m.line for m in kept)
    return [
        replace(m, name=f"{m.result.name}, {m.run.name}") if counts[m.line] > 1 else m for m in kept
    ]


def shared_names(measurements: Iterable[Measurement]) -> list[str]:
    """Return a name for each result, which a model's results on several benchmarks share.

    A second result of a model on the same items has the name of its run, too.
    """
    used: set[tuple] = set()
    names = []
    for m in measurements:
        names.append(m.name if m.line[1:] in used else m.result.name)
        used.add(m.line[1:])
    return names


def group_by_items(measurements: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """Return the results by item set: results on different items never share a table."""
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.items, []).append(m)
    return groups


def transfer_benchmarks(measurements: Sequence[Measurement]) -> set[str]:
    """Return the benchmarks that test transfer.

    No model was trained on them, and they are transfer suites or measure a trained model.
    """
    trained_on = {m.training_benchmark for m in measurements if m.training_benchmark}
    measured = {m.benchmark for m in measurements if m.is_transfer_suite or m.training_benchmark}
    return measured - trained_on


def widest_results(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return the results over all queries at each model's largest width, released models first."""
    widest: dict[tuple[Path, str], Measurement] = {}
    for m in measurements:
        # A report has the widest first.
        if m.result.builder is None:
            widest.setdefault((m.run.folder, m.name), m)
    return sorted(widest.values(), key=lambda m: m.trained)


def check_builds(measurements: Iterable[Measurement]) -> None:
    """Raise a UserError if two runs measured different builds of a benchmark.

    The items and queries of two builds can differ although their ids agree.
    """
    builds: dict[str, Measurement] = {}
    for m in measurements:
        other = builds.setdefault(m.benchmark, m)
        if m.run.report.build != other.run.report.build:
            raise UserError(
                f"{other.run.folder} and {m.run.folder} measured different builds of benchmark "
                f"{m.benchmark}: measure one of them again (run=NAME), or leave it out with "
                "runs=[...]",
                code="different-builds",
            )


def compare_models(
    models: Mapping[str, tuple[Measurement, Responses]],
    items: Mapping[str, SelectionItem],
    seed: int,
) -> list[PairedComparison]:
    """Compare the pairs of models that the paper compares: by family, macro, and over all items.

    Args:
        models: Models of one benchmark by label, with their responses.
        items: The benchmark's items by id.
        seed: Seed of the bootstrap over scenes.
    """
    comparisons: list[PairedComparison] = []
    for pair in permutations(models, 2):
        if not _is_paper_comparison(*(models[label][0] for label in pair)):
            continue
        credits = [
            {k: r.credit(items[k].letter) for k, r in models[label][1].items()} for label in pair
        ]
        answered = [item for item_id, item in items.items() if item_id in credits[0]]
        if answered:
            comparisons += compare_runs(answered, *credits, pair, seed)
    return comparisons


def _is_paper_comparison(m: Measurement, other: Measurement) -> bool:
    """Whether the paper compares such models. These are:

    - a student and its base in the same mode,
    - a student with rationales and one without, of the same base and seed,
    - the full student and an ablated one, of the same base, seed and mode,
    - a retriever and its untrained base.
    """
    if m.run.kind == "similarity":
        # The row of a common base is kept once, under the run that measured it first.
        return m.trained and not other.trained and other.result in m.run.report.rows
    if m.regime not in REGIMES or other.base != m.base:
        return False
    same_mode = other.result.mode == m.result.mode
    if not other.trained:
        return same_mode
    if other.seed != m.seed:
        return False
    if other.regime == "answer_only":
        return m.regime != "answer_only"
    return m.regime == "cot" and other.regime in ABLATED_REGIMES and same_mode
