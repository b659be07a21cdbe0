"""The report's tables of several runs, in the paper's groups."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from dynapix.data.checks.intervals import Interval
from dynapix.data.checks.observer import SIMULATES
from dynapix.data.checks.observer_curve import ObserverCurve
from dynapix.evaluation.metrics.results import SIMILARITY, RetrievalResult, SelectionResult
from dynapix.evaluation.metrics.seeds import MACRO
from dynapix.evaluation.reporting.measurements import (
    TRANSFER_SUITES,
    Measurement,
    SeededResult,
)
from dynapix.evaluation.reporting.reference import table_with_paper
from dynapix.evaluation.reporting.table import Row, Table, file_stem
from dynapix.evaluation.reporting.tables import (
    FAMILY_COLUMNS,
    INTERVAL_NOTE,
    RECALL_COLUMNS,
    SELECTION_COLUMNS,
    SELECTION_NOTE,
    retrieval_columns,
    retrieval_notes,
    retrieval_row,
    selection_rows,
)

GROUPS = (
    "similarity scorers",
    "generative models",
    "trained",
    "two-stage predict-then-match",
    "direct embedders",
)
"""Labels of the groups of measured models, in their order. Baselines and people follow."""
BEST = {
    **dict.fromkeys((*FAMILY_COLUMNS, "Macro", "Micro", *RECALL_COLUMNS, "MRR"), max),
    **dict.fromkeys(("Median", "Twin"), min),
}
"""The columns whose best value is marked, with the function that chooses it."""
BEST_NOTE = "Bold: the best value of a column among these runs, and among the paper's rows."

OBSERVER = "Observer (px)"
OBSERVER_NOTE = (
    f"{OBSERVER}: the error of the observer that simulates the scene and has the same micro "
    "accuracy on the same items, px at 336 x 336, with the interval of the accuracy."
)


def summary_table(
    name: str,
    rows: Sequence[Measurement],
    people: Sequence[Row] = (),
    baselines: Sequence[SelectionResult] = (),
    observers: Mapping[str, ObserverCurve] = MappingProxyType({}),
) -> Table:
    """Return the results of many runs on the same items, in the groups of the paper's tables.

    Args:
        name: Key below `tables` in `reference.yaml`.
        people: Rows of human studies.
        baselines: Results of the baselines on the same items.
        observers: The curves of the observers on the same items, if they have seen them.
    """
    groups: dict[str, list[Row]] = {label: [] for label in GROUPS}
    if isinstance(rows[0].result, SelectionResult):
        columns, notes = SELECTION_COLUMNS, (SELECTION_NOTE, BEST_NOTE)
        for m in rows:
            groups[_group(m)] += selection_rows(m.label, m.result)
    else:
        first = rows[0].result
        columns, notes = retrieval_columns(first), (*retrieval_notes(first), BEST_NOTE)
        for m in rows:
            groups[_group(m)].append(retrieval_row(m.name, m.result))
    baseline_rows = [selection_rows(r.name, r)[0] for r in baselines]
    if observers:
        place = columns.index("Micro") + 1
        columns, notes = [*columns[:place], OBSERVER, *columns[place:]], (*notes, OBSERVER_NOTE)
        curve = observers[SIMULATES]
        for row in [*(row for own in groups.values() for row in own), *baseline_rows]:
            if "Micro" in row:
                row[OBSERVER] = str(curve.error_of(row["Micro"]))
    groups["baselines, from the oracle"] = [{**row, "ranked": False} for row in baseline_rows]
    groups["people, on the items of their study"] = [*people]
    item_set = rows[0].item_set
    table = table_with_paper(name, file_stem(f"{name}-{item_set}"), columns, groups, notes)
    # The paper's rows are of standard items and of the standard test.
    paper = {} if rows[0].variants else table.paper
    return replace(table, caption=f"{table.caption}, on {item_set}", best=BEST, paper=paper)


def _group(m: Measurement) -> str:
    if isinstance(m.result, RetrievalResult):
        two_stage = m.run.kind == "two_stage"
        return "two-stage predict-then-match" if two_stage else "direct embedders"
    if m.trained:
        return "trained"
    return "similarity scorers" if m.result.mode == SIMILARITY else "generative models"


def seed_tables(
    results: Sequence[SeededResult], differences: Mapping[str, Mapping[str, Interval]], group: str
) -> list[Table]:
    """Return the table of trainings with several seeds, and that of the differences between them;
    neither without such trainings."""
    columns = [*FAMILY_COLUMNS, "Macro"]
    note = "95% intervals are bootstrapped over scenes and seeds."

    def cells(found: Mapping[str, Interval]) -> dict[str, Interval]:
        return {name.capitalize(): interval for name, interval in found.items()}

    rows = [
        {
            "name": r.name, **cells(r.accuracies), "Items": r.accuracies[MACRO].n,
            "By seed": " ".join(f"{100 * r.macros[seed]:.1f}" for seed in sorted(r.macros)),
        }
        for r in results
    ]  # fmt: skip
    compared = [{"name": name, **cells(found)} for name, found in differences.items()]
    tables = [
        Table(
            file_stem(f"seeds-{group}"), f"Trainings with several seeds: accuracy (%), on {group}",
            [*columns, "By seed", "Items"], {"": rows}, (f"{note} By seed: macro.",),
        ),
        Table(
            file_stem(f"seed-differences-{group}"),
            f"Differences between trainings with several seeds (%), on {group}",
            columns, {"": compared}, (note,), signed=True,
        ),
    ]  # fmt: skip
    return [table for table in tables if table.groups[""]]


def overall_table(
    name: str, rows: Sequence[Measurement], label: Callable[[Measurement], str]
) -> Table:
    """Return a table of the accuracies over all items of a benchmark, with a row for each model and
    a column for each benchmark.

    Args:
        name: Key below `tables` in `reference.yaml`.
        label: Returns the name of a result's row.
    """
    benchmarks = _benchmark_columns(rows)
    columns = list(dict.fromkeys(["In domain", *TRANSFER_SUITES.values(), *benchmarks]))
    by_label: dict[str, dict[str, Any]] = {}
    for m, column in zip(rows, benchmarks, strict=True):
        empty = {"name": label(m), **dict.fromkeys(columns)}
        by_label.setdefault(empty["name"], empty)[column] = m.result.micro
    notes = (INTERVAL_NOTE, BEST_NOTE)
    table = table_with_paper(name, name, columns, {"": [*by_label.values()]}, notes)
    return replace(table, best=dict.fromkeys(columns, max))


def _benchmark_columns(rows: Sequence[Measurement]) -> list[str]:
    """Return the column of each result: "In domain", a transfer suite, or a benchmark.

    If several benchmarks would have the same column, each gets its own, with its name appended.
    """
    trained_on = {m.training_benchmark for m in rows if m.training_benchmark}

    def column(m: Measurement) -> str:
        # A released model has no training benchmark. It is in domain if a trained model is.
        if m.benchmark in ({m.training_benchmark} if m.trained else trained_on):
            return "In domain"
        simulator = m.run.config.get("benchmark", {}).get("simulator")
        return TRANSFER_SUITES.get(simulator, m.group)

    benchmarks = Counter(name for name, _ in {(column(m), m.group) for m in rows})
    return [
        f"{name} ({m.group})" if benchmarks[name] > 1 else name
        for m, name in zip(rows, map(column, rows), strict=True)
    ]
