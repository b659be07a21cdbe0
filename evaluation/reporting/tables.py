"""The tables of single evaluations; their rows also fill the report's tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from data.records import FAMILIES, LETTERS
from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting.reference import SUITE, reference, reference_rows
from evaluation.reporting.results import RECALLS, SIMILARITY, RetrievalResult, SelectionResult
from evaluation.reporting.table import Table

Rows = list[list[str]]
FAMILY_COLUMNS = [family.capitalize() for family in FAMILIES]
SELECTION_COLUMNS = [*FAMILY_COLUMNS, "Macro", "Micro", "Parsed", "Items"]
MEASURE_COLUMNS = [*(f"R@{k}" for k in RECALLS), "MRR", "Median", "Tied"]
RETRIEVAL_COLUMNS = ["Width", *MEASURE_COLUMNS, "Queries", "Frames"]

SELECTION_NOTE = (
    "Wilson 95% intervals; macro's is bootstrapped over scenes. Answers that cannot be parsed "
    "count as wrong."
)
RETRIEVAL_NOTE = (
    "95% intervals are bootstrapped over scenes. A target that is not ranked counts as last."
)
MCNEMAR_NOTE = (
    "p: McNemar's exact test of these two counts, which treats the items of a scene as independent."
)


def selection_table(results: Sequence[SelectionResult], suite: str = SUITE) -> Table:
    """The results above the paper's rows, if the items are of the paper's suite."""
    groups = {"": selection_rows(results)}
    if suite == SUITE:
        similarity = any(result.mode == SIMILARITY for result in results)
        names = ["chance", *(["selection_similarity"] if similarity else [])]
        names += ["selection_distilled", "human_majority"]
        rows = [row for name in names for row in reference_rows(name, SELECTION_COLUMNS)]
        groups["paper (full benchmark)"] = rows
    head = ["Selection accuracy, %", *SELECTION_COLUMNS]
    return Table("selection", "Selection accuracy (%)", head, groups, (SELECTION_NOTE,))


def selection_rows(results: Iterable[SelectionResult]) -> Rows:
    """For each result a row under `SELECTION_COLUMNS`, its intervals, and its time horizons."""
    rows = []
    for r in results:
        parsed = [percent(r.parse_rate)]
        name = f"{r.name} ({r.mode})"
        rows += _accuracy_rows(name, r.families, r.macro, r.micro, parsed, r.macro_interval)
        for horizon, share in r.horizons.items():
            label = f"  time, {horizon} ({interval_cell(share)})"
            rows.append([label, "", percent(share.value), "", "", "", "", f"{share.n:,}"])
    return rows


def _accuracy_rows(
    name: str,
    families: Mapping[str, Interval],
    macro: float,
    micro: Interval,
    parsed: Sequence[str] = (),
    macro_interval: Interval | None = None,
) -> Rows:
    """A row of accuracies, the cells of `parsed` before the number of items, and its intervals."""
    by_family = [families.get(family) for family in FAMILIES]
    shares = [*(share and share.value for share in by_family), macro, micro.value]
    intervals = map(interval_cell, (*by_family, macro_interval, micro))
    return [
        [name, *map(percent, shares), *parsed, f"{micro.n:,}"],
        ["  95% interval", *intervals, *[""] * len(parsed), ""],
    ]


def detail_tables(
    subtypes: Mapping[str, Mapping[str, Interval]],
    readings: Mapping[str, Mapping[str, int]],
    positions: Mapping[str, PositionBias],
    calibrations: Mapping[str, Calibration],
) -> list[Table]:
    """The tables that detail selection results, each argument by the label of the model or mode."""
    tables = [subtype_table(subtypes)] if subtypes else []
    tables += [parsing_table(readings)] if readings else []
    tables += [position_table(positions)] if positions else []
    for k, (label, calibration) in enumerate(calibrations.items()):
        tables.append(replace(calibration_table(label, calibration), name=f"calibration-{k}"))
    return tables


def subtype_table(subtypes: Mapping[str, Mapping[str, Interval]]) -> Table:
    """Accuracy of each subtype (`family/subtype`), a column for each label."""
    rows = []
    for subtype, first in next(iter(subtypes.values())).items():
        shares = [cells[subtype] for cells in subtypes.values()]
        rows.append([subtype, *map(_share_cell, shares), str(first.n)])
    head = ["Accuracy by subtype, %", *subtypes, "Items"]
    return Table("subtypes", "Selection accuracy by subtype (%)", head, {"": rows})


def parsing_table(readings: Mapping[str, Mapping[str, int]], head: str = "Answers") -> Table:
    """Counts of parsed answers and of the reasons why others could not be parsed, by label."""
    names = list(dict.fromkeys(name for counts in readings.values() for name in counts))
    rows = [
        [name, *(f"{counts[name]:,}" if name in counts else "-" for counts in readings.values())]
        for name in names
    ]
    caption = "Parsed answers, and why others could not be parsed"
    return Table("parsing", caption, [head, *readings], {"": rows})


def position_table(positions: Mapping[str, PositionBias]) -> Table:
    """By label: how often each letter was chosen and was correct, and the accuracy at each."""
    rows = []
    for label, bias in positions.items():
        chosen, total = sum(bias.chosen.values()), sum(bias.right.values())
        for name, counts, totals, answers in (
            ("chosen", bias.chosen, dict.fromkeys(LETTERS, chosen), chosen),
            ("correct", bias.right, dict.fromkeys(LETTERS, total), total),
            ("accuracy", bias.hits, bias.right, total),
        ):
            shares = [percent(counts[x] / totals[x] if totals[x] else None) for x in LETTERS]
            rows.append([f"{label}: {name}", *shares, f"{answers:,}"])
        if bias.p is not None:
            test = f"  chi-square {bias.chi_square:.1f}, p = {bias.p:.2g}"
            rows.append([test, *[""] * (len(LETTERS) + 1)])
    head = ["Letters, %", *LETTERS, "Answers"]
    return Table("positions", "Chosen and correct letters (%)", head, {"": rows})


def calibration_table(label: str, calibration: Calibration) -> Table:
    """Accuracy of the answers by their reported confidence."""
    rows = [
        [
            f"{b.low:.1f} to {b.high:.1f}",
            f"{100 * b.confidence:.1f}",
            percent(b.accuracy.value),
            interval_cell(b.accuracy),
            f"{b.accuracy.n:,}",
        ]
        for b in calibration.bins
    ]
    head = [f"Reported confidence ({label}), %", "Mean", "Accuracy", "95%", "Answers"]
    note = (
        f"Expected calibration error {calibration.ece:.3f} and Brier score "
        f"{calibration.brier:.3f} of {calibration.n:,} valid records."
    )
    return Table("calibration", "Accuracy by reported confidence", head, {"": rows}, (note,))


def paired_table(comparisons: Sequence[tuple[str, Sequence[PairedComparison]]]) -> Table:
    """Paired differences of accuracy by family, a group for each labelled comparison."""
    groups = {
        f"{label}: {of[0].left} (left) less {of[0].right} (right)": [
            [p.of, percent(p.left_accuracy), percent(p.right_accuracy), *_difference_cells(p)]
            for p in of
        ]
        for label, of in comparisons
    }
    head = ["Paired accuracy, %", "Left", "Right", "Difference", "95%", "Only left", "Only right"]
    note = (
        "Difference: left less right, its interval bootstrapped over scenes. Only left, only "
        f"right: items that only this side answers correctly. {MCNEMAR_NOTE}"
    )
    caption = "Paired differences of accuracy"
    return Table("paired", caption, [*head, "p", "Items"], groups, (note,))


def model_differences_table(comparisons: Sequence[Sequence[PairedComparison]]) -> Table:
    """Differences between models over all items, grouped by the model that is subtracted."""
    groups: dict[str, Rows] = {}
    for *_, overall in comparisons:
        group = groups.setdefault(f"less {overall.right}", [])
        group.append([overall.left, *_difference_cells(overall)])
    head = ["All items, %", "Difference", "95%", "Won", "Lost", "p", "Items"]
    note = (
        "Intervals are bootstrapped over scenes. Won, lost: items that only the row's model, or "
        f"only the other one, answers correctly. {MCNEMAR_NOTE}"
    )
    caption = "Differences between models, item by item"
    return Table("differences", caption, head, groups, (note,))


def _difference_cells(p: PairedComparison) -> list[str]:
    return [
        f"{100 * p.difference:+.1f}",
        f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
        *("-" if count is None else f"{count:,}" for count in (p.only_left, p.only_right)),
        "-" if p.p is None else f"{p.p:.2g}",
        f"{p.n:,}",
    ]


def retrieval_table(
    results: Sequence[RetrievalResult], reference_group: str = "retrieval_distilled"
) -> Table:
    """The results over all queries, widest first and untrained before trained, above the paper's
    rows of `reference_group`."""
    overall = [r for r in results if r.builder is None]
    overall.sort(key=lambda r: (-(r.width or 0), not r.untrained))
    groups = {
        "": retrieval_rows(overall),
        "paper (2,002 queries, 10,000 frames)": reference_rows(reference_group, RETRIEVAL_COLUMNS),
    }
    head = ["Retrieval", *RETRIEVAL_COLUMNS]
    return Table("retrieval", "Retrieval (recall in %)", head, groups, (RETRIEVAL_NOTE,))


def retrieval_rows(results: Iterable[RetrievalResult]) -> Rows:
    """For each result a row under `RETRIEVAL_COLUMNS` and its intervals."""
    rows = []
    for r in results:
        rows.append([r.name, _width(r), *_measures(r), f"{r.queries:,}", f"{r.frames:,}"])
        rows.append(["  95% interval", "", *_measure_intervals(r), "", ""])
    return rows


def cost_table(results: Sequence[RetrievalResult]) -> Table:
    """Quality and cost of the results over all queries, the best first."""
    overall = sorted((r for r in results if r.builder is None), key=lambda r: -r.mrr.value)
    rows = [
        [
            r.name,
            _width(r),
            percent(r.recall_10.value),
            f"{r.mrr.value:.3f}",
            "-" if r.bytes is None else f"{r.bytes / 2**20:,.2f}",
            "-" if r.seconds is None else f"{r.seconds:,.2f}",
        ]
        for r in overall
    ]
    head = ["Quality and cost", "Width", "R@10", "MRR", "MiB", "s"]
    note = (
        "MiB: size of the database's embeddings. s: time to rank all queries; an exact search "
        "ranks at all widths at once."
    )
    return Table("costs", "Quality and cost of retrievers", head, {"": rows}, (note,))


def builder_tables(results: Sequence[RetrievalResult]) -> list[Table]:
    """A table for each retriever: its measures and their intervals by builder and width."""
    tables = []
    for name in dict.fromkeys(r.name for r in results):
        rows = []
        for r in (r for r in results if r.name == name):
            queries = "all queries" if r.builder is None else f"builder {r.builder}"
            pairs = zip(_measures(r), _measure_intervals(r), strict=True)
            cells = [f"{value} [{interval}]" for value, interval in pairs]
            rows.append([queries, _width(r), *cells, str(r.queries)])
        head = [f"{name} by builder", "Width", *MEASURE_COLUMNS, "Queries"]
        tables.append(Table("builders", f"Retrieval by builder: {name}", head, {"": rows}))
    return tables


def index_table(indexes: Sequence[dict[str, Any]]) -> Table:
    """Approximate indexes compared with an exact search, as `evaluation.retrieval.faiss_index`
    describes them, each with a `name`."""
    rows = [
        [
            index["name"],
            str(index["width"]),
            *(percent(index[f"recall@{k}"]) for k in RECALLS),
            f"{index['bytes'] / 2**20:,.1f}",
            f"{index['seconds']:.2f}",
        ]
        for index in indexes
    ]
    head = ["Index against exact search", "Width", *(f"R@{k}" for k in RECALLS), "MiB", "s"]
    note = "R@k: share of the exact first k that the index also ranks among its first k."
    caption = "Approximate indexes against exact search"
    return Table("indexes", caption, head, {"": rows}, (note,))


def rank_differences_table(differences: Sequence[dict[str, Any]]) -> Table:
    """The differences of `evaluation.metrics.breakdown.compare_retrievers`, grouped by the pair of
    retrievers: for each width a row, and a row of its intervals."""
    groups: dict[str, Rows] = {}
    for difference in differences:
        values, intervals = [], []
        for measure, found in difference["measures"].items():
            scale, form = (1, "+.3f") if measure == "mrr" else (100, "+.1f")
            value, low, high = (f"{scale * found[key]:{form}}" for key in ("value", "low", "high"))
            values.append(value)
            intervals.append(f"{low} to {high}")
        width = "-" if difference["width"] is None else str(difference["width"])
        rows = groups.setdefault(f"{difference['left']} less {difference['right']}", [])
        rows += [[f"at width {width}", *values], ["  95% interval", *intervals]]
    head = ["Difference of recall, %", *(f"R@{k}" for k in RECALLS), "MRR"]
    note = "Intervals are bootstrapped over scenes."
    caption = "Differences between retrievers, query by query"
    return Table("rank-differences", caption, head, groups, (note,))


def human_table(summary: dict[str, Any]) -> Table:
    """The `evaluation.study.agreement.summary` of a study beside the paper's."""
    rows = [
        row for name, accuracy in summary["accuracy"].items() for row in _human_rows(name, accuracy)
    ]
    if summary["majority"]:
        rows += _human_rows("Majority vote", summary["majority"])
    for clock in ("server", "client"):
        times = [summary["seconds"].get(family, {}).get(clock) for family in FAMILIES]
        cells = ["-" if time is None else f"{time:.1f}" for time in times]
        rows.append([f"Median seconds, {clock}", *cells, "", "", ""])
    columns = [*FAMILY_COLUMNS, "Macro", "Micro", "Items"]
    groups = {
        "": rows,
        "paper, Table 11 (59 items of three simulators)": [
            row
            for name in ("human_annotators", "human_majority", "human_seconds")
            for row in reference_rows(name, columns)
        ],
    }
    head = ["Human accuracy, %", *columns]
    return Table("human", "Human accuracy (%)", head, groups, _human_notes(summary))


def majority_rows(name: str, summary: dict[str, Any]) -> Rows:
    """The majority vote of a study's summary under `SELECTION_COLUMNS`; no row without votes."""
    return _human_rows(name, summary["majority"], ["-"]) if summary["majority"] else []


def _human_rows(name: str, accuracy: dict[str, Any], parsed: Sequence[str] = ()) -> Rows:
    families = {family: Interval(**share) for family, share in accuracy["families"].items()}
    return _accuracy_rows(name, families, accuracy["macro"], Interval(**accuracy["micro"]), parsed)


def _human_notes(summary: dict[str, Any]) -> tuple[str, ...]:
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


def _width(result: RetrievalResult) -> str:
    return "-" if result.width is None else str(result.width)


def _measures(result: RetrievalResult) -> list[str]:
    recalls = [percent(result.measures[f"recall@{k}"].value) for k in RECALLS]
    median, ties = f"{result.median_rank.value:g}", percent(result.tie_rate.value)
    return [*recalls, f"{result.mrr.value:.3f}", median, ties]


def _measure_intervals(result: RetrievalResult) -> list[str]:
    recalls = [interval_cell(result.measures[f"recall@{k}"]) for k in RECALLS]
    mrr = f"{result.mrr.low:.2f}-{result.mrr.high:.2f}"
    median = f"{result.median_rank.low:.0f}-{result.median_rank.high:.0f}"
    return [*recalls, mrr, median, interval_cell(result.tie_rate)]


def _share_cell(share: Interval) -> str:
    return f"{percent(share.value)} [{interval_cell(share)}]"


def percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def interval_cell(interval: Interval | None) -> str:
    """Both ends of an interval in percent; empty for None."""
    return "" if interval is None else f"{100 * interval.low:.0f}-{100 * interval.high:.0f}"
