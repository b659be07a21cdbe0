"""The results of all runs, each with what the report needs of its run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from evaluation.metrics.results import UNTRAINED, RetrievalResult, SelectionResult, from_json
from evaluation.reporting.runs import FinishedRun, reading, training_settings

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
    """A result in a run's report, with its run.

    Attributes:
        name: The name of the model in the report; the result has its name in the run.
        training: Settings of the training run; None for a released model, empty if unknown.
    """

    row: SelectionResult | RetrievalResult
    run: FinishedRun
    name: str
    training: dict[str, Any] | None

    @property
    def variants(self) -> list[str]:
        """The suite and the control of its items; empty for the benchmark's unchanged items."""
        if isinstance(self.row, RetrievalResult):
            return []
        return [variant for variant in (self.row.suite, self.row.control) if variant is not None]

    @property
    def items(self) -> str:
        """The name of its item set: the benchmark and the variants."""
        return ", ".join([self.row.benchmark, *self.variants])

    @property
    def trained(self) -> bool:
        return self.training is not None

    @property
    def regime(self) -> str | None:
        return (self.training or {}).get("train", {}).get("regime")

    @property
    def home(self) -> str | None:
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
        return f"{self.name} ({self.row.mode})"

    @property
    def is_transfer_suite(self) -> bool:
        """Whether its items are of a transfer suite or of its stand-in."""
        benchmark = self.run.config.get("benchmark", {})
        return bool({benchmark.get("simulator"), benchmark.get("standin")} & {*TRANSFER_SUITES})

    @property
    def line(self) -> tuple:
        """The line of a table that the result belongs to."""
        row = self.row
        variant = row.mode if isinstance(row, SelectionResult) else (row.width, row.builder)
        return self.run.kind, self.items, row.name, variant


def read_measurements(
    runs: Iterable[FinishedRun], root: Path, kinds: Sequence[str], result_type: type
) -> list[Measurement]:
    """The results of the runs of some kinds below `root`.

    Raises:
        UserError: a report is damaged or of another version.
    """
    measurements = []
    for run in runs:
        if run.kind in kinds:
            training = training_settings(run, root)
            with reading(run.folder):
                rows = from_json(list[result_type], run.report["rows"])
            # A trained retriever's report also has rows of its untrained base.
            measurements += [
                Measurement(
                    row, run, row.name, None if row.name.startswith(UNTRAINED) else training
                )
                for row in rows
            ]
    return measurements


def deduplicate(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Each result once: the reports of several retrievers repeat the row of their common base.

    Different results of one name get the names of their runs.
    """
    kept: list[Measurement] = []
    for m in measurements:
        if all(m.row != other.row for other in kept):
            kept.append(m)
    counts = Counter(m.line for m in kept)
    return [
        replace(m, name=f"{m.row.name}, {m.run.name}") if counts[m.line] > 1 else m for m in kept
    ]


def shared_names(measurements: Iterable[Measurement]) -> list[str]:
    """A name for each result such that the results of one model on several benchmarks share it; a
    second result on the same items keeps the name with its run."""
    used: set[tuple] = set()
    names = []
    for m in measurements:
        names.append(m.name if m.line[1:] in used else m.row.name)
        used.add(m.line[1:])
    return names


def group_by_items(measurements: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """The results by their item set: those on different items never share a table."""
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.items, []).append(m)
    return groups


def transfer_benchmarks(measurements: Sequence[Measurement]) -> set[str]:
    """Benchmarks that no model was trained on and that are transfer suites, or on which models are
    measured that were trained on another benchmark."""
    homes = {m.home for m in measurements if m.home}
    measured = {m.row.benchmark for m in measurements if m.is_transfer_suite or m.home}
    return measured - homes


def widest_results(measurements: Iterable[Measurement]) -> list[Measurement]:
    """The results over all queries at the largest width of each model, released models first."""
    widest: dict[tuple[Path, str], Measurement] = {}
    for m in measurements:
        # A report has the widest first.
        if m.row.builder is None:
            widest.setdefault((m.run.folder, m.name), m)
    return sorted(widest.values(), key=lambda m: m.trained)
