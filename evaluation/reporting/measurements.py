"""The rows of all runs' reports, each with what the report needs of its run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from evaluation.reporting.results import UNTRAINED, RetrievalResult, SelectionResult
from evaluation.reporting.runs import (
    RETRIEVAL_KINDS,
    SELECTION_KINDS,
    FinishedRun,
    reading,
    training_settings,
)

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
    """A row of a run's report, with its run.

    Attributes:
        training: Settings of the training run; None for a released model, empty if unknown.
        reported_name: The model's name in the run's report, if the row's name is another.
    """

    row: SelectionResult | RetrievalResult
    run: FinishedRun
    training: dict[str, Any] | None = None
    reported_name: str | None = None

    @property
    def benchmark(self) -> str:
        return self.row.benchmark

    @property
    def variants(self) -> list[str]:
        """The suite and the control of its items; empty for the benchmark's unchanged items."""
        if isinstance(self.row, RetrievalResult):
            return []
        return [variant for variant in (self.row.suite, self.row.control) if variant is not None]

    @property
    def items(self) -> str:
        """The name of its item set: the benchmark and the variants."""
        return ", ".join([self.benchmark, *self.variants])

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
    def seed(self) -> int | None:
        """The seed of the training."""
        return (self.training or {}).get("seed")

    @property
    def base(self) -> str | None:
        """The base of a student, or the released model itself."""
        settings = self.training if self.trained else self.run.config
        return settings.get("student", {}).get("name")

    @property
    def model(self) -> str:
        """The model's name in the run's report."""
        return self.reported_name or self.row.name

    @property
    def label(self) -> str:
        return f"{self.row.name} ({self.row.mode})"

    @property
    def report_key(self) -> str:
        """The key of a selection row's details in its report: the mode, or the embedder's name."""
        return self.model if self.run.kind == "similarity" else self.row.mode

    @property
    def column(self) -> str:
        """The heading of this benchmark's column."""
        simulator = self.run.config.get("benchmark", {}).get("simulator")
        return TRANSFER_SUITES.get(simulator, self.benchmark)

    @property
    def is_transfer_suite(self) -> bool:
        """Whether its items are of a transfer suite or of its stand-in."""
        benchmark = self.run.config.get("benchmark", {})
        return bool({benchmark.get("simulator"), benchmark.get("standin")} & {*TRANSFER_SUITES})


def read_measurements(
    runs: Sequence[FinishedRun], root: Path
) -> tuple[list[Measurement], list[Measurement]]:
    """The selection and the retrieval rows of runs below `root`.

    Raises:
        UserError: a report is damaged or of another version.
    """
    kinds = ((SELECTION_KINDS, SelectionResult), (RETRIEVAL_KINDS, RetrievalResult))
    selections, retrievals = (
        [m for run in runs if run.kind in names for m in _read_rows(run, root, row_type)]
        for names, row_type in kinds
    )
    return selections, retrievals


def _read_rows(
    run: FinishedRun, root: Path, row_type: type[SelectionResult] | type[RetrievalResult]
) -> Iterator[Measurement]:
    training = training_settings(run, root)
    with reading(run.folder):
        rows = [row_type.from_dict(row) for row in run.report["rows"]]
    for row in rows:
        # A trained retriever's report also has rows of its untrained base.
        yield Measurement(row, run, None if row.name.startswith(UNTRAINED) else training)


def deduplicate(rows: Iterable[Measurement]) -> list[Measurement]:
    """Each row once: the reports of several retrievers repeat the row of their common base.

    Different rows of one name get the names of their runs.
    """
    kept: list[Measurement] = []
    for m in rows:
        if all(m.row != other.row for other in kept):
            kept.append(m)
    counts = Counter(map(_line, kept))
    return [_name_run(m) if counts[_line(m)] > 1 else m for m in kept]


def _line(m: Measurement) -> tuple:
    """The line of a table that the row belongs to."""
    row = m.row
    variant = row.mode if isinstance(row, SelectionResult) else (row.width, row.builder)
    return m.run.kind, m.items, row.name, variant


def _name_run(m: Measurement) -> Measurement:
    row = replace(m.row, name=f"{m.row.name}, {m.run.name}")
    return replace(m, row=row, reported_name=m.row.name)


def model_names(rows: Sequence[Measurement]) -> list[str]:
    """A name for each row such that the rows of one model on several benchmarks share it; a second
    row on the same items keeps the name with its run."""
    used: set[tuple[str, str, str]] = set()
    names = []
    for m in rows:
        cell = (m.model, m.row.mode, m.items)
        names.append(m.row.name if cell in used else m.model)
        used.add(cell)
    return names


def group_by_items(rows: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """The rows by their item set: rows on different items never share a table."""
    groups: dict[str, list[Measurement]] = {}
    for m in rows:
        groups.setdefault(m.items, []).append(m)
    return groups


def transfer_benchmarks(rows: Sequence[Measurement]) -> set[str]:
    """Benchmarks that no model was trained on and that are transfer suites, or on which models are
    measured that were trained on another benchmark."""
    homes = {m.home for m in rows if m.home}
    return {
        m.benchmark for m in rows if m.is_transfer_suite or m.home not in (None, m.benchmark)
    } - homes


def widest_rows(rows: Sequence[Measurement]) -> list[Measurement]:
    """The rows over all queries at the largest width of each run's model."""
    widest: dict[tuple[Path, str], Measurement] = {}
    for m in rows:
        key = (m.run.folder, m.row.name)
        if m.row.builder is None and (
            key not in widest or (m.row.width or 0) > (widest[key].row.width or 0)
        ):
            widest[key] = m
    return list(widest.values())
