"""The results of all runs, with the training of the measured models, and comparisons of models."""

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
"""Names of the paper's transfer suites, by the setting `benchmark.simulator`."""
REGIMES = {
    "answer_only": "answer-only",
    "cot": "full student",
    "cot_no_candidate_analysis": "- candidate analysis",
    "cot_no_match_layout": "- match layout",
}
"""The paper's names of the training regimes, which differ in the text that a student learns."""
ABLATED_REGIMES = ("cot_no_candidate_analysis", "cot_no_match_layout")
"""The regimes whose rationales lack a part."""


@dataclass(frozen=True)
class Measurement:
    """A result with its run and the training of the measured model.

    Attributes:
        name: Name of the model in the report: `result.name`, or a longer name that is unique.
        training: Settings of the model's training run; None for a released model, empty if unknown.
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
        """The suite and the control, if any; empty for the standard items without a control."""
        if isinstance(self.result, RetrievalResult):
            return []
        return [x for x in (self.result.suite, self.result.control) if x is not None]

    @property
    def item_set(self) -> str:
        """The name of the measured items: benchmark, suite and control."""
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
        """The seed of the training, if known."""
        return (self.training or {}).get("seed")

    @property
    def label(self) -> str:
        return f"{self.name} ({self.result.mode})"

    @property
    def is_transfer_suite(self) -> bool:
        """Whether the benchmark is a transfer suite, or a simulated stand-in for one."""
        benchmark = self.run.config.get("benchmark", {})
        return bool({benchmark.get("simulator"), benchmark.get("standin")} & {*TRANSFER_SUITES})

    @property
    def row_key(self) -> tuple:
        """Key of the result's row in a table; results with equal keys need different names."""
        result = self.result
        is_selection = isinstance(result, SelectionResult)
        variant = result.mode if is_selection else (result.width, result.builder)
        return self.run.kind, self.item_set, result.name, variant


def read_measurements(
    runs: Iterable[FinishedRun], root: Path, kinds: Sequence[str]
) -> list[Measurement]:
    """Return the results of the runs of some kinds. The training runs are below `root`, too."""
    measurements = []
    for run in runs:
        if run.kind in kinds:
            training = training_settings(run, root)
            for row in run.report.rows:
                # The report of a trained retriever also has rows for its untrained base.
                trained = None if row.name.startswith(UNTRAINED) else training
                measurements.append(Measurement(row, run, row.name, trained))
    return measurements


def deduplicate(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Drop repeated results, and give the others unique names.

    Retrievers with the same base each report the results of that base. If different results have
    the same name, the names of their runs are appended.
    """
    kept: list[Measurement] = []
    for m in measurements:
        if all(m.result != other.result for other in kept):
            kept.append(m)
    counts = Counter(m.row_key for m in kept)
    return [
        replace(m, name=f"{m.result.name}, {m.run.name}") if counts[m.row_key] > 1 else m
        for m in kept
    ]


def shared_names(measurements: Iterable[Measurement]) -> list[str]:
    """Return a name for each result. Results of a model on several item sets get the same name.

    If a model has several results on an item set, only the first gets that name. The others get
    their unique names, which contain the names of their runs.
    """
    used: set[tuple] = set()
    names = []
    for m in measurements:
        names.append(m.name if m.row_key[1:] in used else m.result.name)
        used.add(m.row_key[1:])
    return names


def group_by_item_set(measurements: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """Return the results by item set: results on different items are never in the same table."""
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.item_set, []).append(m)
    return groups


def transfer_benchmarks(measurements: Sequence[Measurement]) -> set[str]:
    """Return the benchmarks that test transfer to other scenes.

    These are the benchmarks on which no model was trained, if they are transfer suites or if a
    trained model was measured on them.
    """
    trained_on = {m.training_benchmark for m in measurements if m.training_benchmark}
    measured = {m.benchmark for m in measurements if m.is_transfer_suite or m.training_benchmark}
    return measured - trained_on


def widest_results(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return the results over all queries at each model's largest width, released models first."""
    widest: dict[tuple[Path, str], Measurement] = {}
    for m in measurements:
        # The rows of a report are sorted by width, widest first.
        if m.result.builder is None:
            widest.setdefault((m.run.folder, m.name), m)
    return sorted(widest.values(), key=lambda m: m.trained)


def check_builds(measurements: Iterable[Measurement]) -> None:
    """Raise a UserError if two runs measured different builds of a benchmark.

    Items and queries of two builds can differ although they have the same ids.
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
    """Compare the pairs of models that the paper compares; see `compare_runs`.

    Args:
        models: The models that were measured on a benchmark, with their responses, by label.
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
    """Return whether the paper compares `m` with a model such as `other`. It compares:

    - a student with its base, in the same mode;
    - a student that learned rationales with an answer-only student of the same base and seed;
    - the full student with an ablated student of the same base, seed and mode;
    - a retriever with its untrained base.
    """
    if m.run.kind == "similarity":
        # `other.run` may be another run: a base that several runs measured is kept only once.
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
