"""The tables of single evaluations; their rows also fill the report's tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from data.records import FAMILIES, LETTERS
from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.results import (
    RECALLS,
    SIMILARITY,
    RetrievalResult,
    RetrieverDifference,
    SelectionResult,
    from_json,
)
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting.reference import SUITE, reference, table_reference
from evaluation.reporting.table import DETAIL, Row, Table

FAMILY_COLUMNS = [family.capitalize() for family in FAMILIES]
SELECTION_COLUMNS = [*FAMILY_COLUMNS, "Macro", "Micro", "Parsed", "Items"]
RECALL_COLUMNS = [f"R@{k}" for k in RECALLS]
MEASURE_COLUMNS = [*RECALL_COLUMNS, "MRR", "Median", "Tied"]
RETRIEVAL_COLUMNS = ["Width", *MEASURE_COLUMNS, "MiB", "s"]

SELECTION_NOTE = (
    "Wilson 95% intervals; macro's is bootstrapped over scenes. Answers that cannot be parsed "
    "count as wrong."
)
RETRIEVAL_NOTE = (
    "95% intervals are bootstrapped over scenes. A target that is not ranked counts as last. MiB: "
    "size of the database's embeddings. s: time to rank all queries; an exact search ranks at all "
    "widths at once."
)


def selection_table(results: Sequence[SelectionResult], suite: str = SUITE) -> Table:
    """The results above the paper's rows, if the items are of the paper's suite."""
    rows = [row for r in results for row in selection_rows(f"{r.name} ({r.variant})", r)]
    table = "similarity" if results[0].mode == SIMILARITY else "select"
    paper = table_reference(table) if suite == SUITE else {}
    caption = reference("tables")[table]["caption"]
    return Table("selection", caption, SELECTION_COLUMNS, {"": rows}, (SELECTION_NOTE,), paper)


def selection_rows(name: str, result: SelectionResult) -> list[Row]:
    """A result under `SELECTION_COLUMNS`, and its accuracies by horizon of the time family."""
    row = accuracy_row(name, result.families, result.macro_interval, result.micro)
    horizons = [
        {"name": f"{DETAIL}time, {horizon}", "Time": share, "Items": share.n, "ranked": False}
        for horizon, share in result.horizons.items()
        if horizon.endswith(" s")
    ]
    return [{**row, "Parsed": result.parse_rate}, *horizons]


def accuracy_row(
    name: str, families: Mapping[str, Interval], macro: float | Interval, micro: Interval
) -> Row:
    by_family = {family.capitalize(): families.get(family) for family in FAMILIES}
    return {"name": name, **by_family, "Macro": macro, "Micro": micro, "Items": micro.n}


def detail_tables(
    subtypes: Mapping[str, Mapping[str, Interval]],
    parsing: Mapping[str, Mapping[str, int]],
    positions: Mapping[str, PositionBias],
    calibrations: Mapping[str, Calibration],
) -> list[Table]:
    """The tables that detail selection results, each argument by the label of the model or mode."""
    tables = []
    if subtypes:
        counts = {name: share.n for of in subtypes.values() for name, share in of.items()}
        rows = [{**row, "Items": counts[row["name"]]} for row in rows_by_label(subtypes)]
        caption = "Selection accuracy by subtype (%)"
        tables.append(Table("subtypes", caption, [*subtypes, "Items"], {"": rows}))
    tables += [parsing_table(parsing)] if parsing else []
    tables += [position_table(positions)] if positions else []
    for k, (label, calibration) in enumerate(calibrations.items()):
        tables.append(calibration_table(f"calibration-{k}", label, calibration))
    return tables


def rows_by_label(values: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """A row for each name that some label has a value of, with a column for each label."""
    names = dict.fromkeys(name for of_label in values.values() for name in of_label)
    return [
        {"name": name, **{label: of_label.get(name) for label, of_label in values.items()}}
        for name in names
    ]


def parsing_table(counts: Mapping[str, Mapping[str, int]]) -> Table:
    """Counts of parsed responses and of the reasons why others could not be parsed, by label."""
    caption = "Parsed responses, and why others could not be parsed"
    return Table("parsing", caption, [*counts], {"": rows_by_label(counts)})


def position_table(positions: Mapping[str, PositionBias]) -> Table:
    """By label: how often each letter was chosen and was correct, and the accuracy at each."""
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
        if bias.p is not None:
            rows.append({"name": f"{DETAIL}chi-square {bias.chi_square:.1f}, p = {bias.p:.2g}"})
    caption = "Chosen and correct letters (%)"
    return Table("positions", caption, [*LETTERS, "Answers"], {"": rows})


def calibration_table(name: str, label: str, calibration: Calibration) -> Table:
    """Accuracy of the answers by their reported confidence."""
    rows = [
        {
            "name": f"{b.low:.1f} to {b.high:.1f}", "Mean confidence": b.confidence,
            "Accuracy": b.accuracy, "Answers": b.accuracy.n,
        }
        for b in calibration.bins
    ]  # fmt: skip
    note = (
        f"Expected calibration error {calibration.ece:.3f} and Brier score "
        f"{calibration.brier:.3f} of {calibration.n:,} valid records."
    )
    caption = f"Accuracy by reported confidence (%): {label}"
    return Table(name, caption, ["Mean confidence", "Accuracy", "Answers"], {"": rows}, (note,))


def paired_table(comparisons: Iterable[tuple[str, Sequence[PairedComparison]]]) -> Table:
    """Paired differences of accuracy by family, a group for each comparison and its label."""
    groups = {
        f"{label}{': ' * bool(label)}{of[0].left} (left) less {of[0].right} (right)": [
            {
                "name": p.of, "Left": p.left_accuracy, "Right": p.right_accuracy,
                "Difference": f"{100 * p.difference:+.1f}",
                "95%": f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
                "Only left": p.only_left, "Only right": p.only_right,
                "p": "-" if p.p is None else f"{p.p:.2g}", "Items": p.n,
            }
            for p in of
        ]
        for label, of in comparisons
    }  # fmt: skip
    columns = [
        "Left", "Right", "Difference", "95%", "Only left", "Only right", "p", "Items",
    ]  # fmt: skip
    note = (
        "Difference: left less right, its interval bootstrapped over scenes. Only left, only "
        "right: items that only this side answers correctly. p: McNemar's exact test of these two "
        "counts, which treats the items of a scene as independent."
    )
    return Table("paired", "Paired differences of accuracy (%)", columns, groups, (note,))


def retrieval_table(results: Sequence[RetrievalResult], command: str = "retrieve") -> Table:
    """The results over all queries, widest first and untrained before trained, above the paper's
    rows.

    Args:
        command: retrieve or two_stage.
    """
    overall = [r for r in results if r.builder is None]
    overall.sort(key=lambda r: (-(r.width or 0), not r.untrained))
    rows = {"": [retrieval_row(r.name, r) for r in overall]}
    caption, notes = reference("tables")[command]["caption"], retrieval_notes(overall[0])
    paper = table_reference(command)
    return Table("retrieval", caption, RETRIEVAL_COLUMNS, rows, notes, paper)


def retrieval_row(name: str, result: RetrievalResult) -> Row:
    """A result under `RETRIEVAL_COLUMNS`."""
    measures = dict(zip(MEASURE_COLUMNS, result.measures.values(), strict=True))
    return {
        "name": name, "Width": _width(result.width), **measures,
        "MiB": None if result.bytes is None else f"{result.bytes / 2**20:,.2f}",
        "s": None if result.seconds is None else f"{result.seconds:,.2f}",
    }  # fmt: skip


def retrieval_notes(result: RetrievalResult) -> tuple[str, ...]:
    """The notes of a table of results on the queries of `result`."""
    return f"{result.queries:,} queries, {result.frames:,} frames.", RETRIEVAL_NOTE


def builder_tables(results: Sequence[RetrievalResult]) -> list[Table]:
    """A table for each retriever: its measures by builder and width."""
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
    """Differences grouped by the pair of retrievers, with a row for each width."""
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
    """The `evaluation.study.agreement.summary` of a study beside the paper's."""
    rows = [human_row(name, accuracy) for name, accuracy in summary["accuracy"].items()]
    if summary["majority"]:
        rows.append(human_row("Majority vote", summary["majority"]))
    for clock in ("server", "client"):
        times = {f: summary["seconds"].get(f, {}).get(clock) for f in FAMILIES}
        cells = {f.capitalize(): time and f"{time:.1f}" for f, time in times.items()}
        rows.append({"name": f"Median seconds, {clock}", **cells})
    columns = [*FAMILY_COLUMNS, "Macro", "Micro", "Items"]
    caption, notes = reference("tables")["human"]["caption"], _human_notes(summary)
    return Table("human", caption, columns, {"": rows}, notes, table_reference("human"))


def human_row(name: str, accuracy: Mapping[str, Any]) -> Row:
    """The accuracy of annotators, from a study's summary. It does not compete with models."""
    families = from_json(dict[str, Interval], accuracy["families"])
    micro = from_json(Interval, accuracy["micro"])
    row = accuracy_row(name, families, accuracy["macro"], micro)
    return {**row, "Parsed": None, "ranked": False}


def _human_notes(summary: Mapping[str, Any]) -> tuple[str, ...]:
    depth = [f"{items} with {votes}" for votes, items in summary["depth"].items()]
    kappa, alpha = summary["fleiss_kappa"], summary["krippendorff_alpha"]
    undecided = summary["majority"]["undecided"] if summary["majority"] else 0
    return (
        "Wilson 95% intervals over items.",
        f"{summary['judgments']:,} judgments of {summary['items']:,} items; items by their number "
        f"of judgments: {', '.join(depth)}.",
        f"A majority is more than half of an item's votes; {undecided} items have none and count "
        "as wrong.",
        f"Fleiss' kappa: {_agreement(kappa['value'])} on the {kappa['items']} items that all "
        f"{len(summary['annotators'])} annotators answered (paper: {reference('human_kappa'):.2f} "
        "on 19).",
        f"Krippendorff's alpha: {_agreement(alpha['value'])} on the {alpha['items']} items with "
        "two votes or more.",
        "Seconds: only pages that were loaded once; the server's clock includes time in which the "
        "server was down.",
    )


def _agreement(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def _width(width: int | None) -> str:
    return "-" if width is None else str(width)
