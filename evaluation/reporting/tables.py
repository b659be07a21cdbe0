"""The tables of evaluations and of the report, which also show the paper's results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from data.records import FAMILIES, LETTERS
from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.results import (
    RECALLS,
    SIMILARITY,
    Accuracy,
    RetrievalResult,
    RetrieverDifference,
    SelectionReport,
    SelectionResult,
    from_json,
)
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting.measurements import TRANSFER_SUITES, Measurement, shared_names
from evaluation.reporting.reference import SUITE, reference, table_with_paper
from evaluation.reporting.table import DETAIL, Row, Table

FAMILY_COLUMNS = [family.capitalize() for family in FAMILIES]
SELECTION_COLUMNS = [*FAMILY_COLUMNS, "Macro", "Micro", "Parsed", "Items"]
RECALL_COLUMNS = [f"R@{k}" for k in RECALLS]
MEASURE_COLUMNS = [*RECALL_COLUMNS, "MRR", "Median", "Tied"]
RETRIEVAL_COLUMNS = ["Width", *MEASURE_COLUMNS, "MiB", "s"]

GROUPS = (
    "similarity scorers",
    "generative models",
    "trained",
    "two-stage predict-then-match",
    "direct embedders",
)
"""Labels of the groups of rows in the report's tables, in their order."""
BEST = {
    **dict.fromkeys((*FAMILY_COLUMNS, "Macro", "Micro", *RECALL_COLUMNS, "MRR"), max),
    "Median": min,
}
"""The columns whose best value is marked, with the function that chooses it."""
BEST_NOTE = "Bold: the best value of a column among these runs, and among the paper's rows."
SELECTION_NOTE = (
    "Wilson 95% intervals; the interval of macro is bootstrapped over scenes. Answers that cannot "
    "be parsed count as wrong."
)
RETRIEVAL_NOTE = (
    "95% intervals are bootstrapped over scenes. A target that is not ranked counts as last. MiB: "
    "size of the database's embeddings. s: time to rank the database for all queries, at all "
    "widths together."
)


def selection_table(results: Sequence[SelectionResult], suite: str = SUITE) -> Table:
    """Return the results of a run, above the paper's rows if the items are of the paper's suite."""
    rows = [row for r in results for row in selection_rows(f"{r.name} ({r.variant})", r)]
    key = "similarity" if results[0].mode == SIMILARITY else "select"
    table = table_with_paper(key, "selection", SELECTION_COLUMNS, {"": rows}, (SELECTION_NOTE,))
    return table if suite == SUITE else replace(table, paper={})


def selection_rows(name: str, result: SelectionResult) -> list[Row]:
    """Return a row of `SELECTION_COLUMNS`, and a row for each horizon of the time family."""
    row = accuracy_row(name, result.families, result.macro_interval, result.micro)
    horizons = [
        {"name": f"{DETAIL}time, {horizon}", "Time": accuracy, "Items": accuracy.n, "ranked": False}
        for horizon, accuracy in result.horizons.items()
        if horizon.endswith(" s")
    ]
    return [{**row, "Parsed": result.parse_rate}, *horizons]


def accuracy_row(
    name: str, families: Mapping[str, Interval], macro: float | Interval, micro: Interval
) -> Row:
    by_family = {family.capitalize(): families.get(family) for family in FAMILIES}
    return {"name": name, **by_family, "Macro": macro, "Micro": micro, "Items": micro.n}


def detail_tables(reports: Mapping[str, tuple[str, SelectionReport]]) -> list[Table]:
    """Return the tables of the details of selection results.

    Args:
        reports: By label (of a model or mode): the key of its details, and the report with them.
    """

    def details(name: str) -> dict[str, Any]:
        by_label = {label: getattr(r, name).get(key) for label, (key, r) in reports.items()}
        return {label: found for label, found in by_label.items() if found}

    tables = []
    if subtypes := details("subtypes"):
        counts = {name: i.n for intervals in subtypes.values() for name, i in intervals.items()}
        rows = [{**row, "Items": counts[row["name"]]} for row in rows_by_label(subtypes)]
        caption = "Selection accuracy by subtype (%)"
        tables.append(Table("subtypes", caption, [*subtypes, "Items"], {"": rows}))
    makers = {
        "readings": parsing_table, "positions": position_table, "calibration": calibration_table
    }  # fmt: skip
    return [*tables, *(make(found) for name, make in makers.items() if (found := details(name)))]


def rows_by_label(values: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Convert values by label and name to a row for each name, with a column for each label."""
    names = dict.fromkeys(name for by_name in values.values() for name in by_name)
    return [
        {"name": name, **{label: by_name.get(name) for label, by_name in values.items()}}
        for name in names
    ]


def parsing_table(counts: Mapping[str, Mapping[str, int]]) -> Table:
    """Return a table of the numbers of parsed responses, and of the others by reason, by label."""
    caption = "Parsed responses, and why others could not be parsed"
    return Table("parsing", caption, [*counts], {"": rows_by_label(counts)})


def position_table(positions: Mapping[str, PositionBias]) -> Table:
    """Return a table with three rows for each label: how often each letter was chosen, how often it
    was correct, and how often it was chosen where it was correct."""
    rows: list[Row] = []
    for label, bias in positions.items():
        chosen, total = sum(bias.chosen.values()), sum(bias.right.values())
        for name, counts, totals, answers in (
            ("chosen", bias.chosen, dict.fromkeys(LETTERS, chosen), chosen),
            ("correct", bias.right, dict.fromkeys(LETTERS, total), total),
            ("accuracy", bias.hits, bias.right, total),
        ):
            shares = {x: counts[x] / totals[x] if totals[x] else None for x in LETTERS}
            rows.append({"name": f"{label}: {name}", **shares, "Answers": answers})
    caption = "Chosen and correct letters (%)"
    return Table("positions", caption, [*LETTERS, "Answers"], {"": rows})


def calibration_table(calibrations: Mapping[str, Calibration]) -> Table:
    """Return a table of the calibration of the confidences in valid records, by label."""
    columns = ["Confidence", "Accuracy", "Calibration error", "Brier score", "Records"]
    rows = [
        {
            "name": label, "Confidence": c.confidence, "Accuracy": c.accuracy,
            "Calibration error": f"{c.ece:.3f}", "Brier score": f"{c.brier:.3f}", "Records": c.n,
        }
        for label, c in calibrations.items()
    ]  # fmt: skip
    return Table("calibration", "Calibration of the reported confidence", columns, {"": rows})


def paired_table(comparisons: Iterable[PairedComparison]) -> Table:
    """Return a table of paired differences, with a group for each pair of runs."""
    groups: dict[str, list[Row]] = {}
    for p in comparisons:
        label = f"{p.mode}{': ' * bool(p.mode)}{p.left} (left) less {p.right} (right)"
        row = {
            "name": p.of, "Left": p.left_accuracy, "Right": p.right_accuracy,
            "Difference": f"{100 * p.difference:+.1f}",
            "95%": f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
            "Only left": p.only_left, "Only right": p.only_right,
            "p": "-" if p.p is None else f"{p.p:.2g}", "Items": p.n,
        }  # fmt: skip
        groups.setdefault(label, []).append(row)
    columns = [
        "Left", "Right", "Difference", "95%", "Only left", "Only right", "p", "Items",
    ]  # fmt: skip
    note = (
        "Difference: left minus right, with an interval that is bootstrapped over scenes. Only "
        "left, only right: items that only this side answers correctly. p: p-value of McNemar's "
        "exact test of these two counts, which treats the items of a scene as independent."
    )
    return Table("paired", "Paired differences of accuracy (%)", columns, groups, (note,))


def retrieval_table(results: Sequence[RetrievalResult], command: str = "retrieve") -> Table:
    """Return the results over all queries, above the paper's rows.

    Results are sorted by width, widest first, and by training, untrained first.

    Args:
        command: The command that measured the results: retrieve or two_stage.
    """
    overall = [r for r in results if r.builder is None]
    overall.sort(key=lambda r: (-(r.width or 0), not r.untrained))
    rows, notes = [retrieval_row(r.name, r) for r in overall], retrieval_notes(overall[0])
    return table_with_paper(command, "retrieval", RETRIEVAL_COLUMNS, {"": rows}, notes)


def retrieval_row(name: str, result: RetrievalResult) -> Row:
    """Return a row of `RETRIEVAL_COLUMNS`."""
    measures = dict(zip(MEASURE_COLUMNS, result.measures.values(), strict=True))
    return {
        "name": name, "Width": _width(result.width), **measures,
        "MiB": None if result.bytes is None else f"{result.bytes / 2**20:,.2f}",
        "s": None if result.seconds is None else f"{result.seconds:,.2f}",
    }  # fmt: skip


def retrieval_notes(result: RetrievalResult) -> tuple[str, ...]:
    """Return the notes of a table whose results have the same queries and database as `result`."""
    return f"{result.queries:,} queries, {result.frames:,} frames.", RETRIEVAL_NOTE


def builder_tables(results: Sequence[RetrievalResult]) -> list[Table]:
    """Return a table for each retriever, with a row for each builder and width."""
    tables = []
    for name in dict.fromkeys(r.name for r in results):
        rows = [
            retrieval_row(f"builder {r.builder or 'any'} ({r.queries:,} queries)", r)
            for r in results
            if r.name == name
        ]
        caption = f"Retrieval by builder: {name}"
        tables.append(Table("builders", caption, RETRIEVAL_COLUMNS, {"": rows}))
    return tables


def rank_differences_table(differences: Iterable[RetrieverDifference]) -> Table:
    """Return a table of differences: a group for each pair of retrievers, a row for each width."""
    columns = [*RECALL_COLUMNS, "MRR"]
    groups: dict[str, list[Row]] = {}
    for d in differences:
        measures = dict(zip(columns, d.measures.values(), strict=True))
        rows = groups.setdefault(f"{d.left} less {d.right}", [])
        rows.append({"name": f"at width {_width(d.width)}", **measures})
    caption = "Differences between retrievers, query by query (recall in %)"
    note = "Intervals are bootstrapped over scenes."
    return Table("rank-differences", caption, columns, groups, (note,), signed=True)


def human_table(summary: Mapping[str, Any]) -> Table:
    """Return the table of a human study, above the paper's rows.

    Args:
        summary: As `evaluation.study.agreement.summarize_votes` returns it.
    """
    rows = [human_row(name, accuracy) for name, accuracy in summary["accuracy"].items()]
    if summary["majority"]:
        rows.append(human_row("Majority vote", summary["majority"]))
    for clock in ("server", "client"):
        times = {f: summary["seconds"].get(f, {}).get(clock) for f in FAMILIES}
        cells = {f.capitalize(): time and f"{time:.1f}" for f, time in times.items()}
        rows.append({"name": f"Median seconds, {clock}", **cells})
    columns = [*FAMILY_COLUMNS, "Macro", "Micro", "Items"]
    return table_with_paper("human", "human", columns, {"": rows}, _human_notes(summary))


def human_row(name: str, accuracy: Mapping[str, Any]) -> Row:
    """Return the row of an annotator or of the majority vote, which is never marked as the best.

    Args:
        accuracy: An `Accuracy` as JSON, from the summary of a study.
    """
    parsed = from_json(Accuracy, accuracy)
    row = accuracy_row(name, parsed.families, parsed.macro, parsed.micro)
    return {**row, "Parsed": None, "ranked": False}


def _human_notes(summary: Mapping[str, Any]) -> tuple[str, ...]:
    depth = [f"{items} with {votes}" for votes, items in summary["depth"].items()]
    kappa, alpha = summary["fleiss_kappa"], summary["krippendorff_alpha"]
    undecided = summary["majority"]["undecided"] if summary["majority"] else 0
    return (
        "Wilson 95% intervals over items.",
        f"{summary['judgments']:,} judgments of {summary['items']:,} items; items by their number "
        f"of judgments: {', '.join(depth)}.",
        f"A majority is more than half of an item's votes; {undecided} items have no majority and "
        "count as wrong.",
        f"Fleiss' kappa: {_agreement(kappa['value'])} on the {kappa['items']} items that all "
        f"{len(summary['annotators'])} annotators answered (paper: {reference('human_kappa'):.2f} "
        "on 19 items).",
        f"Krippendorff's alpha: {_agreement(alpha['value'])} on the {alpha['items']} items with "
        "two votes or more.",
        "Median seconds: over items whose page was loaded only once. The server's clock includes "
        "time in which the server was down.",
    )


def _agreement(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def _width(width: int | None) -> str:
    return "-" if width is None else str(width)


def summary_table(name: str, rows: Sequence[Measurement], people: Sequence[Row] = ()) -> Table:
    """Return the results of many runs on the same items, in the groups of the paper's tables.

    Args:
        name: Key below `tables` in `reference.yaml`.
        people: Rows of human studies.
    """
    groups: dict[str, list[Row]] = {label: [] for label in GROUPS}
    if isinstance(rows[0].result, SelectionResult):
        columns, notes = SELECTION_COLUMNS, (SELECTION_NOTE, BEST_NOTE)
        for m in rows:
            groups[_group(m)] += selection_rows(m.label, m.result)
    else:
        columns, notes = RETRIEVAL_COLUMNS, (*retrieval_notes(rows[0].result), BEST_NOTE)
        for m in rows:
            groups[_group(m)].append(retrieval_row(m.name, m.result))
    groups["people, on the items of their study"] = [*people]
    item_set = rows[0].item_set
    table = table_with_paper(name, f"{name}-{item_set.replace(', ', '-')}", columns, groups, notes)
    return replace(table, caption=f"{table.caption}, on {item_set}", best=BEST)


def _group(m: Measurement) -> str:
    if isinstance(m.result, RetrievalResult):
        two_stage = m.run.kind == "two_stage"
        return "two-stage predict-then-match" if two_stage else "direct embedders"
    if m.trained:
        return "trained"
    return "similarity scorers" if m.result.mode == SIMILARITY else "generative models"


def overall_table(
    name: str, rows: Sequence[Measurement], label: Callable[[Measurement, str], str]
) -> Table:
    """Return a table of the accuracies over all items of a benchmark, with a row for each model and
    a column for each benchmark.

    Args:
        name: Key below `tables` in `reference.yaml`.
        label: Returns the name of a result's row from the result and the name of its model.
    """
    names, benchmarks = shared_names(rows), _benchmark_columns(rows)
    columns = list(dict.fromkeys(["In domain", *TRANSFER_SUITES.values(), *benchmarks]))
    by_label: dict[str, dict[str, Any]] = {}
    for m, model, column in zip(rows, names, benchmarks, strict=True):
        empty = {"name": label(m, model), **dict.fromkeys(columns)}
        by_label.setdefault(empty["name"], empty)[column] = m.result.micro
    notes = ("Wilson 95% intervals over items.", BEST_NOTE)
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
        return TRANSFER_SUITES.get(simulator, m.benchmark)

    benchmarks = Counter(name for name, _ in {(column(m), m.benchmark) for m in rows})
    return [
        f"{name} ({m.benchmark})" if benchmarks[name] > 1 else name
        for m, name in zip(rows, map(column, rows), strict=True)
    ]
