"""The rows of measured models, each with what its table needs of the run that it stands in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from evaluation.reporting.results import UNTRAINED, RetrievalResult, SelectionResult
from evaluation.reporting.runs import CHOICES, RANKINGS, Finished, training_of, unreadable

SUITES = {"movi_a": "MoVi-A", "physion": "Physion"}
"""The paper's transfer suites by their simulator."""


@dataclass(frozen=True)
class Measured:
    """A row with what its table needs of the run that it stands in.

    `training` holds the settings that the model was trained by, None for one as it was released,
    and nothing where they are not known. `reported` is the name that the run's report gives the
    model, where the row's is another.
    """

    row: SelectionResult | RetrievalResult
    run: Finished
    training: dict[str, Any] | None = None
    reported: str | None = None

    @property
    def benchmark(self) -> str:
        return self.row.benchmark

    @property
    def ways(self) -> list[str]:
        """How its items were chosen and shown, where that is not all of them as they are."""
        if isinstance(self.row, RetrievalResult):
            return []
        return [way for way in (self.row.suite, self.row.control) if way is not None]

    @property
    def items(self) -> str:
        """What its items are called, those of the whole benchmark by its name."""
        return ", ".join([self.benchmark, *self.ways])

    @property
    def trained(self) -> bool:
        return self.training is not None

    @property
    def regime(self) -> str | None:
        """How a student was trained."""
        return (self.training or {}).get("train", {}).get("regime")

    @property
    def home(self) -> str | None:
        """The benchmark that the model was trained on, where that is known."""
        return (self.training or {}).get("benchmark", {}).get("name")

    @property
    def seed(self) -> int | None:
        """That of the training."""
        return (self.training or {}).get("seed")

    @property
    def base(self) -> str | None:
        """What a student began from, or is as it was released."""
        settings = self.training if self.trained else self.run.config
        return settings.get("student", {}).get("name")

    @property
    def model(self) -> str:
        """What the run's report calls the model."""
        return self.reported or self.row.name

    @property
    def label(self) -> str:
        return f"{self.row.name} ({self.row.mode})"

    @property
    def known_by(self) -> str:
        """What the run of a selection row knows it by: the mode in which its one model was asked,
        or which of its embedders chose."""
        return self.model if self.run.kind == "similarity" else self.row.mode

    def told(self, kind: str) -> Any:
        """What else the run reports of a selection row's model, such as its subtypes."""
        return self.run.report.get(kind, {}).get(self.known_by)

    @property
    def column(self) -> str:
        """What a column of this benchmark is called."""
        return SUITES.get(self._benchmark.get("simulator"), self.benchmark)

    @property
    def is_of_suite(self) -> bool:
        """Whether its items are of a transfer suite, or of scenes that stand in for one."""
        told = self._benchmark
        return told.get("simulator") in SUITES or told.get("standin") in SUITES

    @property
    def _benchmark(self) -> dict[str, Any]:
        return self.run.config.get("benchmark", {})


def read_rows(runs: Sequence[Finished], root: Path) -> tuple[list[Measured], list[Measured]]:
    """The selection and the retrieval rows of runs below `root`.

    Raises:
        UserError: a report is of another version.
    """
    choices = [m for run in runs if run.kind in CHOICES for m in _rows(run, root, SelectionResult)]
    ranks = [m for run in runs if run.kind in RANKINGS for m in _rows(run, root, RetrievalResult)]
    return choices, ranks


def _rows(
    run: Finished, root: Path, kind: type[SelectionResult] | type[RetrievalResult]
) -> list[Measured]:
    training = training_of(run, root)
    try:
        rows = [kind.from_dict(row) for row in run.report["rows"]]
    except (KeyError, TypeError) as error:
        raise unreadable(run.folder) from error
    # A trained retriever's report has a row of what it began from, too.
    return [
        Measured(row, run, None if row.name.startswith(UNTRAINED) else training) for row in rows
    ]


def once(rows: Iterable[Measured]) -> list[Measured]:
    """Each row once, for a released model's stands in the reports of several trained from it; and
    what runs measured otherwise under one name, each with its run's name."""
    kept: list[Measured] = []
    for m in rows:
        if all(m.row != other.row for other in kept):
            kept.append(m)
    called = Counter(_place(m) for m in kept)
    return [_with_run(m) if called[_place(m)] > 1 else m for m in kept]


def _place(m: Measured) -> tuple:
    """What tells a row from others of a table."""
    row = m.row
    how = row.mode if isinstance(row, SelectionResult) else (row.width, row.builder)
    return m.run.kind, m.items, row.name, how


def _with_run(m: Measured) -> Measured:
    row = replace(m.row, name=f"{m.row.name}, {m.run.name}")
    return replace(m, row=row, reported=m.row.name)


def model_names(rows: Sequence[Measured]) -> list[str]:
    """Of each row what its line is called where a line is a model on several benchmarks: the model;
    what was measured again on the same items has its run's name."""
    taken: set[tuple[str, str, str]] = set()
    names = []
    for m in rows:
        cell = (m.model, m.row.mode, m.items)
        names.append(m.row.name if cell in taken else m.model)
        taken.add(cell)
    return names


def by_items(rows: Iterable[Measured]) -> dict[str, list[Measured]]:
    """What is measured on other items never stands in one table."""
    found: dict[str, list[Measured]] = {}
    for m in rows:
        found.setdefault(m.items, []).append(m)
    return found


def transfers(rows: Sequence[Measured]) -> set[str]:
    """The benchmarks where no model was trained, which are or stand in for the paper's transfer
    suites, or on which models are measured that were trained elsewhere."""
    homes = {m.home for m in rows if m.home}
    return {m.benchmark for m in rows if m.is_of_suite or m.home not in (None, m.benchmark)} - homes


def widest(rows: Sequence[Measured]) -> list[Measured]:
    """The rows over all queries, of each run's model that of its largest width alone."""
    best: dict[tuple[Path, str], Measured] = {}
    for m in rows:
        key = (m.run.folder, m.row.name)
        if m.row.builder is None and (
            key not in best or (m.row.width or 0) > (best[key].row.width or 0)
        ):
            best[key] = m
    return list(best.values())
