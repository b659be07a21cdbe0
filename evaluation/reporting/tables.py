"""The tables of evaluations and of the report, which also show the paper's results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from dynapix.data.records import FAMILIES
from dynapix.evaluation.metrics.future_moment import FutureMoment
from dynapix.evaluation.metrics.reasons import ReasonSummary
from dynapix.evaluation.metrics.results import (
    MEASURES,
    RECALLS,
    SIMILARITY,
    TWIN_ABOVE,
    Accuracy,
    RetrievalResult,
    RetrieverDifference,
    SelectionReport,
    SelectionResult,
    StudyReport,
)
from dynapix.evaluation.metrics.significance import PairedComparison, PairScores, adjust_holm
from dynapix.evaluation.reporting.reference import SUITE, reference, table_with_paper
from dynapix.evaluation.reporting.table import DETAIL, Row, Table

FAMILY_COLUMNS = [family.capitalize() for family in FAMILIES]
SELECTION_COLUMNS = [*FAMILY_COLUMNS, "Macro", "Micro", "Parsed", "Items"]
RECALL_COLUMNS = [f"R@{k}" for k in RECALLS]
MEASURE_COLUMNS = dict(
    zip((*MEASURES, TWIN_ABOVE), (*RECALL_COLUMNS, "MRR", "Median", "Tied", "Twin"), strict=True)
)
"""The column of each measure of retrieval."""

INTERVAL_NOTE = "95% intervals are bootstrapped over scenes."
SELECTION_NOTE = f"{INTERVAL_NOTE} Answers that cannot be parsed count as wrong."
RETRIEVAL_NOTE = (
    f"{INTERVAL_NOTE} A target that is not ranked counts as last. MiB: "
    "size of the database's embeddings. s: time to rank the database for all queries, at all "
    "widths together."
)
TWIN_NOTE = (
    "Twin: queries for which the frame of the factual scene at the target's moment ranks above the "
    "target (%)."
)


def selection_table(results: Sequence[SelectionResult], suite: str = SUITE) -> Table:
    """Return the results of a run, above the paper's rows if the items are of the paper's suite."""
    rows = [row for r in results for row in selection_rows(f"{r.name} ({r.variant})", r)]
    key = "similarity" if results[0].mode == SIMILARITY else "select"
    table = table_with_paper(key, "selection", SELECTION_COLUMNS, {"": rows}, (SELECTION_NOTE,))
    return table if suite == SUITE else replace(table, paper={})


def selection_rows(name: str, result: SelectionResult) -> list[Row]:
    """Return a row of `SELECTION_COLUMNS`, and a row for each horizon of the time family."""
    row = accuracy_row(name, result)
    horizons = [
        {"name": f"{DETAIL}time, {horizon}", "Time": accuracy, "Items": accuracy.n, "ranked": False}
        for horizon, accuracy in result.horizons.items()
        if horizon.endswith(" s")
    ]
    return [{**row, "Parsed": result.parse_rate}, *horizons]


def accuracy_row(name: str, accuracy: Accuracy | SelectionResult) -> Row:
    by_family = {family.capitalize(): accuracy.families.get(family) for family in FAMILIES}
    overall = {"Macro": accuracy.macro, "Micro": accuracy.micro, "Items": accuracy.micro.n}
    return {"name": name, **by_family, **overall}


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
    makers = {"readings": parsing_table, "reasons": reason_table}
    return [*tables, *(make(found) for name, make in makers.items() if (found := details(name)))]


def future_moment_table(models: Mapping[str, FutureMoment]) -> Table:
    """Return a table of the accuracy on balanced time items, split into future and moment, over the
    time from the prefix to the target."""
    rows = []
    for label, of_model in models.items():
        every = {label: of_model.total, **{f"{DETAIL}{h}": s for h, s in of_model.horizons.items()}}
        rows += [
            {
                "name": name, "Accuracy": shares.accuracy, "Future": shares.future,
                "Moment": shares.moment, "Items": shares.accuracy.n,
            }
            for name, shares in every.items()
        ]  # fmt: skip
    note = (
        f"{SELECTION_NOTE} Future: answers that show the true future, at the right moment or a "
        "wrong one; moment: answers that show the right moment, of the true future or another one. "
        "Chance is 50% for each, and 25% for the accuracy."
    )
    columns = ["Accuracy", "Future", "Moment", "Items"]
    caption = "Balanced time items: future and moment (%)"
    return Table("future-moment", caption, columns, {"": rows}, (note,))


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


def reason_table(reasons: Mapping[str, ReasonSummary]) -> Table:
    """Return a table of what rationales claim: for each label, a row for the answers, and a row for
    the claims about each part."""
    rows: list[Row] = []
    for label, summary in reasons.items():
        rows.append(
            {
                "name": label, "Follows": summary.follows, "True reasons": summary.true,
                "Sufficiency": summary.sufficiency, "Items": summary.follows.n,
            }
        )  # fmt: skip
        for part, of_part in summary.parts.items():
            number = of_part.claims
            rows.append(
                {
                    "name": f"{DETAIL}{part}",
                    "Claims": f"{number.value:.1f} [{number.low:.1f}, {number.high:.1f}]",
                    "Supported": of_part.supported, "Contradicted": of_part.contradicted,
                }
            )  # fmt: skip
    columns = [
        "Claims", "Supported", "Contradicted", "Follows", "True reasons", "Sufficiency", "Items",
    ]  # fmt: skip
    notes = (
        f"{INTERVAL_NOTE} Claims: mean number in a response, and the shares that the oracle "
        "supports and contradicts; it does not know the others. Follows: the text says of the "
        "chosen candidate, and of no other, that it agrees. True reasons: the answer is right and "
        "follows, a claim about what happens is supported, and no claim about it or about a "
        "candidate is contradicted. Sufficiency: the probability that a reader who knows only the "
        "prediction picks the target.",
    )
    return Table("reasons", "Claims and reasons of rationales (%)", columns, {"": rows}, notes)


def paired_table(comparisons: Iterable[PairedComparison]) -> Table:
    """Return a table of paired differences, with a group for each pair of runs."""
    comparisons = list(comparisons)
    adjusted = adjust_holm([p.p for p in comparisons])
    groups: dict[str, list[Row]] = {}
    for p, holm in zip(comparisons, adjusted, strict=True):
        label = f"{p.mode}{': ' * bool(p.mode)}{p.left} (left) minus {p.right} (right)"
        row = {
            "name": p.of, "Left": p.left_accuracy, "Right": p.right_accuracy,
            "Difference": f"{100 * p.difference:+.1f}",
            "95%": f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
            "p": f"{p.p:.2g}", "Holm": f"{holm:.2g}",
            "Only left": p.only_left, "Only right": p.only_right,
            "McNemar": "-" if p.mcnemar is None else f"{p.mcnemar:.2g}", "Items": p.n,
        }  # fmt: skip
        groups.setdefault(label, []).append(row)
    columns = [
        "Left", "Right", "Difference", "95%", "p", "Holm", "Only left", "Only right", "McNemar",
        "Items",
    ]  # fmt: skip
    note = (
        "Difference: left minus right, with an interval that is bootstrapped over scenes. p: sign-"
        "flip test over scenes. Holm: p adjusted for all tests of this table. Only left, only "
        "right: items that only this side answers correctly. McNemar: exact test of these two "
        "counts, which treats the items of a scene as independent."
    )
    return Table("paired", "Paired differences of accuracy (%)", columns, groups, (note,))


def pair_table(scores: Mapping[str, Sequence[PairScores]]) -> Table:
    """Return a table of pairs about interventions, with a group for each model."""
    columns = ["Actual", "Changed", "Both", "Ignored", "Pairs"]
    groups = {
        label: [
            {
                "name": each.of, "Actual": each.actual, "Changed": each.changed,
                "Both": each.both, "Ignored": each.ignored, "Pairs": each.both.n,
            }
            for each in own
        ]
        for label, own in scores.items()
    }  # fmt: skip
    note = (
        f"{INTERVAL_NOTE} Actual, changed: accuracy on the items about what comes, and about what "
        "would have come. Both: pairs with both items right; 6.2 by independent guesses, 8.3 by "
        "one who knows that the two answers differ. Ignored: pairs whose items are both answered "
        "with what comes."
    )
    return Table("pairs", "Pairs about interventions (%)", columns, groups, (note,))


def retrieval_table(results: Sequence[RetrievalResult], command: str = "retrieve") -> Table:
    """Return the results over all queries, above the paper's rows if these are of the same pool.

    Results are sorted by width, widest first, and by training, untrained first.

    Args:
        command: The command that measured the results: retrieve or two_stage.
    """
    overall = [r for r in results if r.builder is None]
    overall.sort(key=lambda r: (-(r.width or 0), not r.untrained))
    rows, notes = [retrieval_row(r.name, r) for r in overall], retrieval_notes(overall[0])
    columns = retrieval_columns(overall[0])
    table = table_with_paper(command, "retrieval", columns, {"": rows}, notes)
    if (pool := overall[0].pool) == "future":
        return table
    return replace(table, caption=f"{table.caption}, {pool} queries", paper={})


def retrieval_columns(result: RetrievalResult) -> list[str]:
    return ["Width", *(MEASURE_COLUMNS[name] for name in result.measures), "MiB", "s"]


def retrieval_row(name: str, result: RetrievalResult) -> Row:
    """Return a row of `retrieval_columns`."""
    measures = {MEASURE_COLUMNS[key]: measure for key, measure in result.measures.items()}
    return {
        "name": name, "Width": _width(result.width), **measures,
        "MiB": None if result.bytes is None else f"{result.bytes / 2**20:,.2f}",
        "s": None if result.seconds is None else f"{result.seconds:,.2f}",
    }  # fmt: skip


def retrieval_notes(result: RetrievalResult) -> tuple[str, ...]:
    """Return the notes of a table whose results have the same queries and database as `result`."""
    notes = f"{result.queries:,} queries, {result.frames:,} frames.", RETRIEVAL_NOTE
    return (*notes, TWIN_NOTE) if TWIN_ABOVE in result.measures else notes


def builder_tables(results: Sequence[RetrievalResult]) -> list[Table]:
    """Return a table for each retriever, with a row for each builder and width; none for queries
    without builders."""
    tables = []
    if all(r.builder is None for r in results):
        return tables
    for name in dict.fromkeys(r.name for r in results):
        rows = [
            retrieval_row(f"builder {r.builder or 'any'} ({r.queries:,} queries)", r)
            for r in results
            if r.name == name
        ]
        caption = f"Retrieval by builder: {name}"
        tables.append(Table("builders", caption, retrieval_columns(results[0]), {"": rows}))
    return tables


def rank_differences_table(differences: Iterable[RetrieverDifference]) -> Table:
    """Return a table of differences: a group for each pair of retrievers, a row for each width."""
    columns: dict[str, None] = {}
    groups: dict[str, list[Row]] = {}
    for d in differences:
        measures = {MEASURE_COLUMNS[name]: interval for name, interval in d.measures.items()}
        columns |= dict.fromkeys(measures)
        rows = groups.setdefault(f"{d.left} minus {d.right}", [])
        rows.append({"name": f"at width {_width(d.width)}", **measures})
    caption = "Differences between retrievers, query by query (recall in %)"
    note = "Intervals are bootstrapped over scenes."
    return Table("rank-differences", caption, [*columns], groups, (note,), signed=True)


def human_table(study: StudyReport) -> Table:
    """Return the table of a human study, above the paper's rows."""
    rows = [human_row(name, accuracy) for name, accuracy in study.accuracy.items()]
    if study.majority:
        rows.append(human_row("Majority vote", study.majority))
    times = {f.capitalize(): f"{seconds:.1f}" for f, seconds in study.seconds.items()}
    rows.append({"name": "Median seconds", **dict.fromkeys(FAMILY_COLUMNS), **times})
    columns = [*FAMILY_COLUMNS, "Macro", "Micro", "Items"]
    return table_with_paper("human", "human", columns, {"": rows}, _human_notes(study))


def human_row(name: str, accuracy: Accuracy) -> Row:
    """Return the row of an annotator or of the majority vote, which is never marked as the best."""
    return {**accuracy_row(name, accuracy), "Parsed": None, "ranked": False}


def _human_notes(study: StudyReport) -> tuple[str, ...]:
    depth = [f"{items} with {votes}" for votes, items in study.depth.items()]
    kappa = "undefined" if study.fleiss_kappa is None else f"{study.fleiss_kappa:.2f}"
    undecided = study.majority.undecided if study.majority else 0
    return (
        INTERVAL_NOTE,
        f"{study.judgments:,} judgments of {study.items:,} items; items by their number "
        f"of judgments: {', '.join(depth)}.",
        f"A majority is more than half of an item's votes; {undecided} items have no majority and "
        "count as wrong.",
        f"Fleiss' kappa: {kappa} on the {study.kappa_items} items that all "
        f"{len(study.annotators)} annotators answered (paper: {reference('human_kappa'):.2f} "
        "on 19 items).",
        "Median seconds: over items whose page was loaded only once.",
    )


def _width(width: int | None) -> str:
    return "-" if width is None else str(width)
