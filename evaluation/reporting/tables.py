"""The tables that show what was measured beside the paper's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from data.records import FAMILIES, LETTERS
from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting import reference as paper
from evaluation.reporting.results import RECALLS, SIMILARITY, RetrievalResult, SelectionResult
from evaluation.reporting.table import Table

SELECTION_HEAD = (*(f.capitalize() for f in FAMILIES), "Macro", "Micro", "Parsed", "Items")
_HEADS = (*(f"R@{k}" for k in RECALLS), "MRR", "Median", "Tied")
RETRIEVAL_HEAD = ("Width", *_HEADS, "Queries", "Frames")
PAPER = "paper (full benchmark)"


def selection_table(rows: Sequence[SelectionResult], suite: str = paper.SUITE) -> Table:
    """The rows, and below them, where the items are of the suite that the paper has by family, the
    paper's; in percent."""
    similar = paper.SELECTION_SIMILARITY if any(r.mode == SIMILARITY for r in rows) else ()
    reference = (
        paper.CHANCE,
        *similar,
        *paper.SELECTION_DISTILLED,
        paper.HUMAN_MAJORITY,
    )
    own = {"": selection_cells(rows)}
    return Table(
        "selection",
        "Selection accuracy (%)",
        ["Selection accuracy, %", *SELECTION_HEAD],
        own | {PAPER: selection_references(reference)} if suite == paper.SUITE else own,
        (SELECTION_NOTE,),
    )


SELECTION_NOTE = (
    "Intervals are Wilson's, macro's bootstrapped over scenes; what cannot be parsed is wrong."
)


def selection_cells(rows: Sequence[SelectionResult]) -> list[list[str]]:
    """Of each row, a line under `SELECTION_HEAD`, one with its intervals, and its time items by how
    far ahead they ask."""
    cells = []
    for r in rows:
        found = [*(r.families.get(f) for f in FAMILIES)]
        shares = [*(i and i.value for i in found), r.macro, r.micro.value, r.parse_rate]
        cells.append([f"{r.name} ({r.mode})", *map(_percent, shares), f"{r.n:,}"])
        spans = map(interval_cell, (*found, r.macro_interval, r.micro))
        cells.append(["  95% interval", *spans, "", ""])
        for horizon, of in r.horizons.items():
            label = f"  time, {horizon} ({interval_cell(of)})"
            cells.append([label, "", _percent(of.value), "", "", "", "", f"{of.n:,}"])
    return cells


def selection_references(rows: Sequence[paper.SelectionReference]) -> list[list[str]]:
    """The paper's rows under `SELECTION_HEAD`."""
    cells = []
    for r in rows:
        shares = (r.event, r.time, r.window, r.macro, r.micro, r.parse_rate)
        cells.append([r.name, *map(_printed, shares), ""])
        if r in paper.SELECTION_DISTILLED:
            for seconds, percent in paper.TIME_BY_HORIZON.get(r.name, {}).items():
                cells.append([f"  time, {seconds} s", "", _printed(percent), *[""] * 5])
    return cells


def subtype_table(subtypes: dict[str, dict[str, Interval]]) -> Table:
    """Accuracy of each subtype (`family/subtype`) in each mode, with its interval and items."""
    modes = list(subtypes)
    rows = []
    for cell in subtypes[modes[0]]:
        found = [subtypes[mode][cell] for mode in modes]
        shares = [f"{_percent(i.value)} [{interval_cell(i)}]" for i in found]
        rows.append([cell, *shares, str(found[0].n)])
    head = ["Accuracy by subtype, %", *modes, "Items"]
    return Table("subtypes", "Selection accuracy by subtype (%)", head, {"": rows})


def paired_table(found: Sequence[tuple[str, Sequence[PairedComparison]]]) -> Table:
    """What two ways of answering the same items are apart, by how these were asked."""
    parts = {
        f"{way}: {of[0].left} (left) less {of[0].right} (right)": [
            [p.of, *map(_percent, (p.left_accuracy, p.right_accuracy)), *_apart(p)] for p in of
        ]
        for way, of in found
    }
    head = ["Paired accuracy, %", "Left", "Right", "Apart", "95%", "Only left", "Only right"]
    note = (
        "Apart: left less right, its interval bootstrapped over scenes. Only left, only right: "
        f"items answered right that way alone; {_MCNEMAR}"
    )
    caption = "Paired differences of accuracy"
    return Table("paired", caption, [*head, "p", "Items"], parts, (note,))


def apart_table(found: Sequence[Sequence[PairedComparison]]) -> Table:
    """What models are apart over all items, a line each under the model it is held against."""
    parts: dict[str, list[list[str]]] = {}
    for of in found:
        over_all = of[-1]
        parts.setdefault(f"less {over_all.right}", []).append([over_all.left, *_apart(over_all)])
    head = ["Apart over all items, %", "Apart", "95%", "Won", "Lost", "p", "Items"]
    note = (
        "The interval is bootstrapped over scenes. Won, lost: items that the row's model, or the "
        f"other one, alone has right; {_MCNEMAR}"
    )
    return Table("apart", "How far models are apart, item by item", head, parts, (note,))


_MCNEMAR = "p is McNemar's exact test of the two, which takes the items of a scene for independent."


def _apart(p: PairedComparison) -> list[str]:
    return [
        f"{100 * p.difference:+.1f}",
        f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
        *("-" if count is None else f"{count:,}" for count in (p.only_left, p.only_right)),
        "-" if p.p is None else f"{p.p:.2g}",
        f"{p.n:,}",
    ]


def position_table(found: dict[str, PositionBias]) -> Table:
    """Of each mode: which letters were chosen, which were right, and how often the model was right
    where each was."""
    cells = []
    for mode, of in found.items():
        chosen, total = sum(of.chosen.values()), sum(of.right.values())
        for name, counts, wholes, answers in (
            ("chosen", of.chosen, dict.fromkeys(LETTERS, chosen), chosen),
            ("right", of.right, dict.fromkeys(LETTERS, total), total),
            ("accuracy", of.hits, of.right, total),
        ):
            shares = [_percent(counts[x] / wholes[x] if wholes[x] else None) for x in LETTERS]
            cells.append([f"{mode}: {name}", *shares, f"{answers:,}"])
        if of.p is not None:
            told = f"  chi-square {of.chi_square:.1f}, p = {of.p:.2g}"
            cells.append([told, *[""] * (len(LETTERS) + 1)])
    caption = "Letters that were chosen and that were right (%)"
    return Table("positions", caption, ["Letters, %", *LETTERS, "Answers"], {"": cells})


def calibration_table(mode: str, found: Calibration) -> Table:
    """How often answers of each reported confidence are right, and what that comes to."""
    cells = [
        [
            f"{b.low:.1f} to {b.high:.1f}",
            f"{100 * b.confidence:.1f}",
            _percent(b.accuracy.value),
            interval_cell(b.accuracy),
            f"{b.accuracy.n:,}",
        ]
        for b in found.bins
    ]
    head = [f"Confidence reported ({mode}), %", "Mean", "Right", "95%", "Answers"]
    note = (
        f"Expected calibration error {found.ece:.3f}, Brier score {found.brier:.3f}, of "
        f"{found.n:,} valid records."
    )
    caption = "How often answers of each reported confidence are right"
    return Table("calibration", caption, head, {"": cells}, (note,))


def parsing_table(reasons: dict[str, dict[str, int]], head: str = "Answers") -> Table:
    """How the answers of each mode could be read: counts by reason."""
    names = list(dict.fromkeys(name for counts in reasons.values() for name in counts))
    cells = [
        [name, *(f"{counts[name]:,}" if name in counts else "-" for counts in reasons.values())]
        for name in names
    ]
    caption = "Answers that could be read, and why others could not"
    return Table("readings", caption, [head, *reasons], {"": cells})


def retrieval_table(
    rows: Sequence[RetrievalResult],
    reference: Sequence[paper.RetrievalReference] = paper.RETRIEVAL_DISTILLED,
) -> Table:
    """The rows over all queries by width, widest first, each width's untrained row on top; then the
    paper's."""
    every = [r for r in rows if r.builder is None]
    ordered = sorted(every, key=lambda r: (-(r.width or 0), not r.untrained))
    return Table(
        "retrieval",
        "Retrieval (recall in %)",
        ["Retrieval", *RETRIEVAL_HEAD],
        {"": retrieval_cells(ordered), PAPER: retrieval_references(reference)},
        (RETRIEVAL_NOTE,),
    )


RETRIEVAL_NOTE = "Intervals are bootstrapped over scenes; a target that is not found is last."


def retrieval_cells(rows: Sequence[RetrievalResult]) -> list[list[str]]:
    """Of each row, a line under `RETRIEVAL_HEAD` and one with its intervals."""
    cells = []
    for r in rows:
        width = "-" if r.width is None else str(r.width)
        cells.append([r.name, width, *_values(r), f"{r.queries:,}", f"{r.frames:,}"])
        cells.append(["  95% interval", "", *_ranges(r), "", ""])
    return cells


def retrieval_references(rows: Sequence[paper.RetrievalReference]) -> list[list[str]]:
    """The paper's rows under `RETRIEVAL_HEAD`."""
    return [
        [
            r.name,
            "",
            *map(_printed, (r.recall_1, r.recall_10, r.recall_50)),
            f"{r.mrr:.3f}",
            str(r.median_rank),
            "",
            "2,002",
            "10,000",
        ]
        for r in rows
    ]


def rank_differences_table(apart: Sequence[dict[str, Any]]) -> Table:
    """What `evaluation.metrics.breakdown.compare_retrievers` gives: under the retrievers' names
    two lines a width,
    the second with the intervals."""
    parts: dict[str, list[list[str]]] = {}
    for of in apart:
        gaps = [_rank_gap(name, measured) for name, measured in of["measures"].items()]
        width = "-" if of["width"] is None else str(of["width"])
        lines = parts.setdefault(f"{of['left']} less {of['right']}", [])
        lines.append([f"at width {width}", *(value for value, _ in gaps)])
        lines.append(["  95% interval", *(interval for _, interval in gaps)])
    head = ["Recall apart, %", *(f"R@{k}" for k in RECALLS), "MRR"]
    note = "Query by query; intervals are bootstrapped over scenes."
    return Table(
        "ranks-apart", "How far retrievers are apart, query by query", head, parts, (note,)
    )


def _rank_gap(measure: str, m: dict[str, float]) -> tuple[str, str]:
    scale, form = (1, "+.3f") if measure == "mrr" else (100, "+.1f")
    value, low, high = (f"{scale * m[key]:{form}}" for key in ("value", "low", "high"))
    return value, f"{low} to {high}"


def cost_table(rows: Sequence[RetrievalResult]) -> Table:
    """What the rows over all queries cost beside what they give, those that give most first."""
    every = [r for r in rows if r.builder is None]
    cells = [
        [
            r.name,
            "-" if r.width is None else str(r.width),
            _percent(r.recall_10.value),
            f"{r.mrr.value:.3f}",
            "-" if r.bytes is None else f"{r.bytes / 2**20:,.2f}",
            "-" if r.seconds is None else f"{r.seconds:,.2f}",
        ]
        for r in sorted(every, key=lambda r: -r.mrr.value)
    ]
    head = ["What it gives and costs", "Width", "R@10", "MRR", "MiB", "s"]
    note = (
        "MiB: of what stands for the database. s: to rank for all queries; an exact search ranks "
        "at all widths at once."
    )
    return Table("costs", "What retrievers give and cost", head, {"": cells}, (note,))


def builder_tables(rows: Sequence[RetrievalResult]) -> list[Table]:
    """A table for each retriever: by builder, at every width, with the intervals."""
    tables = []
    for name in dict.fromkeys(r.name for r in rows):
        cells = []
        for r in [r for r in rows if r.name == name]:
            of = "all queries" if r.builder is None else f"builder {r.builder}"
            pairs = zip(_values(r), _ranges(r), strict=True)
            found = [f"{value} [{span}]" for value, span in pairs]
            cells.append([of, str(r.width), *found, str(r.queries)])
        head = [f"{name} by builder", "Width", *_HEADS, "Queries"]
        tables.append(Table("builders", f"Retrieval by builder: {name}", head, {"": cells}))
    return tables


def index_table(indexes: Sequence[dict[str, Any]]) -> Table:
    """What is told of approximate indexes, as `evaluation.retrieval.faiss_index` gives it, each
    with its `name`."""
    cells = [
        [
            told["name"],
            str(told["width"]),
            *(_percent(told[f"recall@{k}"]) for k in RECALLS),
            f"{told['bytes'] / 2**20:,.1f}",
            f"{told['seconds']:.2f}",
        ]
        for told in indexes
    ]
    recalls = [f"R@{k}" for k in RECALLS]
    head = ["Index, held against exact", "Width", *recalls, "MiB", "s"]
    note = "R@k: of the exact first k, what share the index has among its own first k."
    return Table(
        "indexes", "Approximate indexes held against exact ones", head, {"": cells}, (note,)
    )


def majority_cells(name: str, found: dict[str, Any]) -> list[list[str]]:
    """The majority vote of what `evaluation.study.agreement.summary` found, under
    `SELECTION_HEAD`; nothing where there is none."""
    if not found["majority"]:
        return []
    rows = _human_cells(name, found["majority"])
    return [[*row[:-1], parsed, row[-1]] for row, parsed in zip(rows, ("-", ""), strict=True)]


def _human_cells(name: str, of: dict[str, Any]) -> list[list[str]]:
    each = [Interval(**told) if (told := of["families"].get(f)) else None for f in FAMILIES]
    micro = Interval(**of["micro"])
    shares = [*(i and i.value for i in each), of["macro"], micro.value]
    spans = [*map(interval_cell, each), "", interval_cell(micro)]
    return [[name, *map(_percent, shares), str(micro.n)], ["  95% interval", *spans, ""]]


def human_table(found: dict[str, Any]) -> Table:
    """What `evaluation.study.agreement.summary` found, beside the paper's study."""
    own = [row for name, of in found["accuracy"].items() for row in _human_cells(name, of)]
    if found["majority"]:
        own += _human_cells("Majority vote", found["majority"])
    for clock in ("server", "client"):
        times = [found["seconds"].get(f, {}).get(clock) for f in FAMILIES]
        shown = ["-" if t is None else f"{t:.1f}" for t in times]
        own.append([f"Median seconds, {clock}", *shown, "", "", ""])
    reference = [
        [r.name, *map(_printed, (r.event, r.time, r.window, r.macro)), "", items]
        for r, items in [
            *((r, "") for r in paper.HUMAN_ANNOTATORS),
            (paper.HUMAN_MAJORITY, "59"),
        ]
    ]
    seconds = [f"{paper.HUMAN_SECONDS[f]:.1f}" for f in FAMILIES]
    reference.append(["Median seconds", *seconds, "", "", ""])
    head = ["Human accuracy, %", *(f.capitalize() for f in FAMILIES), "Macro", "Micro", "Items"]
    parts = {"": own, "paper, Table 11 (59 items of three simulators)": reference}
    return Table("human", "Human accuracy (%)", head, parts, _human_notes(found))


def _human_notes(found: dict[str, Any]) -> tuple[str, ...]:
    depth = [f"{items} by {votes}" for votes, items in found["depth"].items()]
    kappa, alpha = found["fleiss_kappa"], found["krippendorff_alpha"]
    undecided = found["majority"]["undecided"] if found["majority"] else 0
    return (
        "Intervals are Wilson's, over items.",
        f"{found['judgments']:,} judgments of {found['items']:,} items; items by how many answered "
        f"them: {', '.join(depth)}.",
        f"Majority is more than half of an item's votes; items without one, counted wrong: "
        f"{undecided}.",
        f"Fleiss' kappa {_agreed(kappa['value'])} on the {kappa['items']} items that all "
        f"{len(found['annotators'])} answered (paper {paper.HUMAN_KAPPA:.2f} on 19).",
        f"Krippendorff's alpha {_agreed(alpha['value'])} on the {alpha['items']} items of two "
        "votes or more.",
        "Seconds are of pages that were loaded once; the server's go on while it is away.",
    )


def _agreed(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def _values(row: RetrievalResult) -> list[str]:
    found = row.measures
    recalls = [_percent(found[f"recall@{k}"].value) for k in RECALLS]
    median, ties = f"{row.median_rank.value:g}", _percent(row.tie_rate.value)
    return [*recalls, f"{row.mrr.value:.3f}", median, ties]


def _ranges(row: RetrievalResult) -> list[str]:
    found = row.measures
    recalls = [interval_cell(found[f"recall@{k}"]) for k in RECALLS]
    mrr = f"{row.mrr.low:.2f}-{row.mrr.high:.2f}"
    median = f"{row.median_rank.low:.0f}-{row.median_rank.high:.0f}"
    return [*recalls, mrr, median, interval_cell(row.tie_rate)]


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def _printed(percent: float | None) -> str:
    return "-" if percent is None else f"{percent:.1f}"


def interval_cell(found: Interval | None) -> str:
    """An interval's ends in percent, nothing where there is none."""
    return "" if found is None else f"{100 * found.low:.0f}-{100 * found.high:.0f}"
