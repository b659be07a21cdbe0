"""The report's tables of many runs, in the paper's shape and above the paper's rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from evaluation.metrics.results import SIMILARITY, SelectionResult
from evaluation.reporting import tables
from evaluation.reporting.measurements import TRANSFER_SUITES, Measurement
from evaluation.reporting.reference import reference, table_reference
from evaluation.reporting.table import Row, Table

GROUPS = (
    "similarity scorers",
    "generative models",
    "trained",
    "two-stage predict-then-match",
    "direct embedders",
)
"""Groups of rows, in their order."""
BEST = {
    **dict.fromkeys(("Event", "Time", "Window", "Macro", "Micro"), max),
    **dict.fromkeys(("R@1", "R@10", "R@50", "MRR"), max),
    "Median": min,
}
"""Columns with a best value."""
BEST_NOTE = "Bold: the best value of a column among these runs, and among the paper's rows."


def summary_table(name: str, rows: Sequence[Measurement], people: Sequence[Row] = ()) -> Table:
    """The results of one track on the same items. The best values are marked among models,
    separately for these runs and for the paper.

    Args:
        name: A table of `reference.yaml`.
        people: Rows of a human study.
    """
    is_selection = isinstance(rows[0].row, SelectionResult)
    groups: dict[str, list[Row]] = {label: [] for label in GROUPS}
    for m in rows:
        if is_selection:
            released = "similarity scorers" if m.row.mode == SIMILARITY else "generative models"
            label = "trained" if m.trained else released
            groups[label] += tables.selection_rows(m.label, m.row)
        else:
            two_stage = m.run.kind == "two_stage"
            label = "two-stage predict-then-match" if two_stage else "direct embedders"
            groups[label].append(tables.retrieval_row(m.name, m.row))
    items = rows[0].items
    notes = (tables.SELECTION_NOTE,) if is_selection else tables.retrieval_notes(rows[0].row)
    return Table(
        f"{name}-{items.replace(', ', '-')}",
        f"{reference('tables')[name]['caption']}, on {items}",
        tables.SELECTION_COLUMNS if is_selection else tables.RETRIEVAL_COLUMNS,
        {**groups, "people, on the items of their study": people},
        (*notes, BEST_NOTE),
        table_reference(name),
        BEST,
    )


def overall_table(name: str, rows: Sequence[Measurement], labels: Sequence[str]) -> Table:
    """Accuracy over all items of a benchmark: a line for each label and a column for each
    benchmark, first the one that the model was trained on.

    Args:
        name: A table of `reference.yaml`.
        labels: The label of each of `rows`.
    """
    benchmarks = _benchmark_columns(rows)
    columns = list(dict.fromkeys(["In domain", *TRANSFER_SUITES.values(), *benchmarks]))
    lines: dict[str, dict[str, Any]] = {}
    for m, label, column in zip(rows, labels, benchmarks, strict=True):
        empty = {"name": label, **dict.fromkeys(columns)}
        lines.setdefault(label, empty)[column] = m.row.micro
    caption, groups = reference("tables")[name]["caption"], {"": [*lines.values()]}
    notes, best = ("Wilson 95% intervals over items.", BEST_NOTE), dict.fromkeys(columns, max)
    return Table(name, caption, columns, groups, notes, table_reference(name), best)


def _benchmark_columns(rows: Sequence[Measurement]) -> list[str]:
    """The column of each row: "In domain", its suite or its benchmark; if several benchmarks would
    share a column, it also names the benchmark."""
    homes = {m.home for m in rows if m.home}
    columns, benchmarks = [], defaultdict(set)
    for m in rows:
        # A released model has no training benchmark: it is in domain where some student is.
        in_domain = m.row.benchmark == m.home or (not m.trained and m.row.benchmark in homes)
        simulator = m.run.config.get("benchmark", {}).get("simulator")
        suite = TRANSFER_SUITES.get(simulator, m.row.benchmark)
        columns.append("In domain" if in_domain else suite)
        benchmarks[columns[-1]].add(m.row.benchmark)
    return [
        f"{column} ({m.row.benchmark})" if len(benchmarks[column]) > 1 else column
        for m, column in zip(rows, columns, strict=True)
    ]
