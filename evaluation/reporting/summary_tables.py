"""The report's tables of many runs, in the paper's shape and above the paper's rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from conf.errors import UserError
from conf.multirun.table import AT_START_SUFFIX
from evaluation.metrics.intervals import Interval
from evaluation.reporting.measurements import TRANSFER_SUITES, Measurement
from evaluation.reporting.reference import NOT_MODELS, reference_rows
from evaluation.reporting.results import SIMILARITY
from evaluation.reporting.runs import FinishedRun, reading
from evaluation.reporting.table import Table, mark_best
from evaluation.reporting.tables import (
    RETRIEVAL_COLUMNS,
    RETRIEVAL_NOTE,
    SELECTION_COLUMNS,
    SELECTION_NOTE,
    Rows,
    interval_cell,
    majority_rows,
    percent,
    retrieval_rows,
    selection_rows,
)

BEST = {
    **dict.fromkeys(("Event", "Time", "Window", "Macro", "Micro"), max),
    **dict.fromkeys(("R@1", "R@10", "R@50", "MRR"), max),
    "Median": min,
}
"""Columns with a best value."""
BEST_NOTE = "Bold: the best value of a column among these runs, and among the paper's rows."


def zero_shot_selection_table(
    benchmark: str, rows: Sequence[Measurement], studies: Sequence[FinishedRun]
) -> Table:
    """Table 2 of the paper, with the majority votes of studies of this benchmark.

    Raises:
        UserError: a study's report is damaged.
    """
    groups = {
        "similarity scorers": selection_rows(m.row for m in rows if m.row.mode == SIMILARITY),
        "generative models": selection_rows(m.row for m in rows if m.row.mode != SIMILARITY),
    }
    people: Rows = []
    for study in studies:
        with reading(study.folder):
            people += majority_rows(f"Majority vote, {study.name}", study.report)
    paper = {
        "paper, Table 2": ["chance", "human_majority"],
        "paper, Table 2: similarity scorers": ["selection_similarity"],
        "paper, Table 2: open generative VLMs": ["selection_generative"],
    }
    caption = f"Zero-shot selection accuracy (%) on {benchmark}"
    head = [f"Zero-shot, {benchmark}", *SELECTION_COLUMNS]
    name = f"selection-{benchmark}"
    return _summary(name, caption, head, groups, paper, SELECTION_NOTE, people)


def trained_selection_table(
    name: str, caption: str, rows: Sequence[Measurement], paper: Mapping[str, list[str]]
) -> Table:
    """Selection accuracies of released and of trained models."""
    groups = {
        "zero-shot": selection_rows(m.row for m in rows if not m.trained),
        "trained": selection_rows(m.row for m in rows if m.trained),
    }
    head = [f"Selection, {rows[0].items}", *SELECTION_COLUMNS]
    return _summary(name, caption, head, groups, paper, SELECTION_NOTE)


def retrieval_summary_table(
    name: str,
    caption: str,
    title: str,
    rows: Sequence[Measurement],
    paper: Mapping[str, list[str]],
) -> Table:
    """Two-stage pipelines and direct embedders, each at its largest width; released ones first."""
    rows = sorted(rows, key=lambda m: m.trained)
    groups = {
        "two-stage predict-then-match": retrieval_rows(
            m.row for m in rows if m.run.kind == "two_stage"
        ),
        "direct embedders": retrieval_rows(m.row for m in rows if m.run.kind == "retrieve"),
    }
    return _summary(name, caption, [title, *RETRIEVAL_COLUMNS], groups, paper, RETRIEVAL_NOTE)


def _summary(
    name: str,
    caption: str,
    head: Sequence[str],
    groups: Mapping[str, Rows],
    paper: Mapping[str, list[str]],
    note: str,
    people: Rows | None = None,
) -> Table:
    """The groups, `people`, and the groups of reference rows that `paper` names by label. The best
    values are marked among models, separately for these runs and for the paper."""
    references = {
        label: [row for group in names for row in reference_rows(group, head[1:])]
        for label, names in paper.items()
    }
    groups = {
        **mark_best(groups, head, BEST),
        "people, on the items of their study": people or [],
        **mark_best(references, head, BEST, NOT_MODELS),
    }
    return Table(name, caption, head, groups, (note, BEST_NOTE))


def overall_table(
    name: str,
    caption: str,
    rows: Sequence[Measurement],
    labels: Sequence[str],
    paper: Mapping[str, str],
) -> Table:
    """Accuracy over all items of a benchmark: a line for each label and a column for each
    benchmark, first the one that the model was trained on.

    Args:
        labels: The label of each of `rows`.
        paper: The group of reference rows by its label in the table.
    """
    columns = _benchmark_columns(rows, labels)
    names = list(dict.fromkeys(["In domain", *TRANSFER_SUITES.values(), *columns]))
    shares: dict[str, dict[str, Interval]] = {}
    for m, label, column in zip(rows, labels, columns, strict=True):
        shares.setdefault(label, {})[column] = m.row.micro
    lines: Rows = []
    for label, by_column in shares.items():
        of_columns = [by_column.get(column) for column in names]
        lines.append([label, *(percent(share and share.value) for share in of_columns)])
        lines.append(["  95% interval", *map(interval_cell, of_columns)])
    head, best = ["Overall accuracy, %", *names], dict.fromkeys(names, max)
    references = {label: reference_rows(group, names) for label, group in paper.items()}
    groups = {**mark_best({"": lines}, head, best), **mark_best(references, head, best)}
    return Table(name, caption, head, groups, ("Wilson 95% intervals over items.", BEST_NOTE))


def _benchmark_columns(rows: Sequence[Measurement], labels: Sequence[str]) -> list[str]:
    """The column of each row: "In domain", its suite or its benchmark.

    Benchmarks of one suite share a column unless it would hold several values: then the column
    names the benchmark too.
    """
    homes = {m.home for m in rows if m.home}
    # A released model has no training benchmark: it is in domain where some student is.
    columns = [
        "In domain"
        if m.benchmark == m.home or (not m.trained and m.benchmark in homes)
        else m.column
        for m in rows
    ]
    benchmarks: dict[tuple[str, str], set[str]] = {}
    for m, label, column in zip(rows, labels, columns, strict=True):
        line = label if column == "In domain" else ""
        benchmarks.setdefault((column, line), set()).add(m.benchmark)
    shared = {column for (column, _), names in benchmarks.items() if len(names) > 1}
    return [
        f"{column} ({m.benchmark})" if column in shared else column
        for m, column in zip(rows, columns, strict=True)
    ]


def training_table(runs: Sequence[FinishedRun]) -> Table:
    """The metrics of each run on held-out training scenes, at its start and at its end.

    Raises:
        UserError: a run's metrics.json is damaged.
    """
    groups = {}
    for run in runs:
        try:
            metrics = json.loads((run.folder / "metrics.json").read_text())
        except ValueError as error:
            raise UserError(
                f"{run.folder / 'metrics.json'} is damaged: delete it and run the training "
                "command again, which writes it without training again",
                code="damaged-file",
            ) from error
        groups[f"{run.kind}/{run.name}"] = [
            [name.replace("_", " "), f"{metrics[name + AT_START_SUFFIX]:.3f}", f"{end:.3f}"]
            for name, end in metrics.items()
            if name + AT_START_SUFFIX in metrics
        ]
    head = ["Training (held-out scenes)", "Start", "End"]
    return Table("training", "Training, on held-out scenes", head, groups)
