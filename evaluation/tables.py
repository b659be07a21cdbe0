"""Result rows and the text tables that show them beside the paper's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from data.records import FAMILIES, LETTERS
from evaluation import paper
from evaluation.confidence import Calibration, Positions
from evaluation.metrics import Accuracy, Interval
from evaluation.paired import Paired

RECALLS = (1, 10, 50)
"""Cut-offs that the retrieval rows report."""
MEASURES = ("mrr", "median_rank", "tie_rate")
"""What they report besides."""
UNTRAINED = "untrained"
"""What the names of rows begin with that a trained retriever is held against."""

SIMILARITY = "similarity"
"""The mode of a retriever that chooses the nearest candidate."""

NAME_WIDTH = 40


@dataclass(frozen=True)
class SelectionRow:
    """One model on one benchmark's selection items, in shares. What could not be parsed counts as
    wrong.

    `mode` says how it was asked, such as answer, reasoning or similarity; `parse_rate` is None
    where nothing is parsed; `n` is the number of items. `horizons` are the time items by their
    distance, "1 s" and "2 s"; the interval of `macro` is drawn over scenes.
    """

    benchmark: str
    name: str
    mode: str
    families: dict[str, Interval]
    macro: float
    micro: Interval
    parse_rate: float | None
    n: int
    macro_interval: Interval | None = None
    horizons: dict[str, Interval] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        benchmark: str,
        name: str,
        mode: str,
        found: Accuracy,
        parse_rate: float | None,
        macro_interval: Interval | None = None,
        horizons: dict[str, Interval] | None = None,
    ) -> SelectionRow:
        shares = (found.families, found.macro, found.micro, parse_rate)
        told = (macro_interval, horizons or {})
        return cls(benchmark, name, mode, *shares, found.micro.n, *told)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> SelectionRow:
        families = {name: Interval(**found) for name, found in row["families"].items()}
        horizons = {name: Interval(**found) for name, found in row.get("horizons", {}).items()}
        macro = row.get("macro_interval")
        whole = {"micro": Interval(**row["micro"]), "macro_interval": macro and Interval(**macro)}
        return cls(**{**row, "families": families, "horizons": horizons, **whole})


@dataclass(frozen=True)
class RetrievalRow:
    """One retriever at one width (None for a pipeline without widths) on the queries of one builder
    (None for all of them), recalls in shares. Intervals are drawn over scenes. `bytes` and
    `seconds` are those of `evaluation.ranking.Ranks`; rows that differ in the time alone are
    equal."""

    benchmark: str
    name: str
    width: int | None
    builder: int | None
    recall_1: Interval
    recall_10: Interval
    recall_50: Interval
    mrr: Interval
    median_rank: Interval
    tie_rate: Interval
    queries: int
    frames: int
    bytes: int | None = None
    seconds: float | None = field(default=None, compare=False)

    @property
    def untrained(self) -> bool:
        return self.name.startswith(UNTRAINED)

    @property
    def measures(self) -> dict[str, Interval]:
        """By the names that `evaluation.metrics` gives them."""
        recalls = {f"recall@{k}": getattr(self, f"recall_{k}") for k in RECALLS}
        return {**recalls, **{name: getattr(self, name) for name in MEASURES}}

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> RetrievalRow:
        names = [f"recall_{k}" for k in RECALLS] + list(MEASURES)
        return cls(**{**row, **{name: Interval(**row[name]) for name in names}})


def selection_table(rows: Sequence[SelectionRow]) -> str:
    """The rows, and below them the paper's, in percent; at most 100 columns wide."""
    own = []
    for r in rows:
        found = [*(r.families.get(f) for f in FAMILIES)]
        shares = [*(i and i.value for i in found), r.macro, r.micro.value, r.parse_rate]
        name = _short(r.name, NAME_WIDTH - len(r.mode) - 3)
        own.append([f"{name} ({r.mode})", *map(_percent, shares), f"{r.n:,}"])
        spans = map(_range, (*found, r.macro_interval, r.micro))
        own.append(["  95% interval", *spans, "", ""])
        for horizon, of in r.horizons.items():
            label = f"  time, {horizon} ({_range(of)})"
            own.append([label, "", _percent(of.value), "", "", "", "", f"{of.n:,}"])
    similar = paper.SELECTION_SIMILARITY if any(r.mode == SIMILARITY for r in rows) else ()
    reference = []
    for r in (paper.CHANCE, *similar, *paper.SELECTION_DISTILLED, paper.HUMAN_MAJORITY):
        shares = (r.event, r.time, r.window, r.macro, r.micro, r.parse_rate)
        reference.append([r.name, *map(_printed, shares), ""])
        for seconds, percent in paper.TIME_BY_HORIZON.get(r.name, {}).items():
            reference.append([f"  time, {seconds} s", "", _printed(percent), *[""] * 5])
    head = ["Selection accuracy, %", *(f.capitalize() for f in FAMILIES)]
    table = _table(
        [*head, "Macro", "Micro", "Parsed", "Items"],
        {"": own, "paper (Qwen3-VL 8B, full benchmark)": reference},
    )
    note = (
        "Intervals are Wilson's, macro's bootstrapped over scenes; what cannot be parsed is wrong."
    )
    return f"{table}\n{note}"


def subtype_table(subtypes: dict[str, dict[str, Interval]]) -> str:
    """Accuracy of each subtype (`family/subtype`) in each mode, with its interval and items."""
    modes = list(subtypes)
    rows = []
    for cell in subtypes[modes[0]]:
        found = [subtypes[mode][cell] for mode in modes]
        shares = [f"{_percent(i.value)} [{_range(i)}]" for i in found]
        rows.append([cell, *shares, str(found[0].n)])
    heads = [_short(mode, NAME_WIDTH) for mode in modes]
    return _table(["Accuracy by subtype, %", *heads, "Items"], {"": rows})


def paired_table(found: Sequence[tuple[str, Sequence[Paired]]]) -> str:
    """What two ways of answering the same items are apart, by how these were asked."""
    parts = {
        f"{way}: {of[0].left} (left) less {of[0].right} (right)": [
            [
                p.of,
                *map(_percent, (p.left_accuracy, p.right_accuracy)),
                f"{100 * p.difference:+.1f}",
                f"{100 * p.low:+.1f} to {100 * p.high:+.1f}",
                *("-" if count is None else f"{count:,}" for count in (p.only_left, p.only_right)),
                "-" if p.p is None else f"{p.p:.2g}",
                f"{p.n:,}",
            ]
            for p in of
        ]
        for way, of in found
    }
    head = ["Paired accuracy, %", "Left", "Right", "Apart", "95%", "Only left", "Only right"]
    table = _table([*head, "p", "Items"], parts)
    return (
        f"{table}\nApart: left less right, its interval bootstrapped over scenes. Only left, only "
        "right: items\nanswered right that way alone; p is McNemar's exact test of the two, which "
        "takes the items of a\nscene for independent."
    )


def position_table(found: dict[str, Positions]) -> str:
    """Of each mode: which letters were chosen, which were right, and how often the model was right
    where each was."""
    cells = []
    for mode, of in found.items():
        total = sum(of.right.values())
        for name, counts, wholes in (
            ("chosen", of.chosen, dict.fromkeys(LETTERS, sum(of.chosen.values()))),
            ("right", of.right, dict.fromkeys(LETTERS, total)),
            ("accuracy", of.hits, of.right),
        ):
            shares = [_percent(counts[x] / wholes[x] if wholes[x] else None) for x in LETTERS]
            cells.append([f"{mode}: {name}", *shares, f"{sum(counts.values()):,}"])
        if of.p is not None:
            told = f"  chi-square {of.chi_square:.1f}, p = {of.p:.2g}"
            cells.append([told, *[""] * (len(LETTERS) + 1)])
    return _table(["Letters, %", *LETTERS, "Answers"], {"": cells})


def calibration_table(mode: str, found: Calibration) -> str:
    """How often answers of each reported confidence are right, and what that comes to."""
    cells = [
        [
            f"{b.low:.1f} to {b.high:.1f}",
            f"{100 * b.confidence:.1f}",
            _percent(b.accuracy.value),
            _range(b.accuracy),
            f"{b.accuracy.n:,}",
        ]
        for b in found.bins
    ]
    head = [f"Confidence reported ({mode}), %", "Mean", "Right", "95%", "Answers"]
    table = _table(head, {"": cells})
    return (
        f"{table}\nExpected calibration error {found.ece:.3f}, Brier score {found.brier:.3f}, of "
        f"{found.n:,} valid records."
    )


def reading_table(reasons: dict[str, dict[str, int]], head: str = "Answers") -> str:
    """How the answers of each mode could be read: counts by reason."""
    names = list(dict.fromkeys(name for counts in reasons.values() for name in counts))
    cells = [
        [name, *(f"{counts[name]:,}" if name in counts else "-" for counts in reasons.values())]
        for name in names
    ]
    return _table([head, *reasons], {"": cells})


def retrieval_table(
    rows: Sequence[RetrievalRow],
    reference: Sequence[paper.RetrievalReference] = paper.RETRIEVAL_DISTILLED,
) -> str:
    """The rows over all queries by width, widest first, each width's untrained row on top; then the
    paper's."""
    every = [r for r in rows if r.builder is None]
    ordered = sorted(every, key=lambda r: (-(r.width or 0), not r.untrained))
    own = []
    for r in ordered:
        width = "-" if r.width is None else str(r.width)
        sizes = [f"{r.queries:,}", f"{r.frames:,}"]
        own.append([_short(r.name, NAME_WIDTH), width, *_values(r), *sizes])
        own.append(["  95% interval", "", *_ranges(r), "", ""])
    printed = [
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
        for r in reference
    ]
    table = _table(
        ["Retrieval", "Width", *_heads(), "Queries", "Frames"],
        {"": own, "paper (Qwen3-VL 8B, full benchmark)": printed},
    )
    return f"{table}\nIntervals are bootstrapped over scenes; a target that is not found is last."


def cost_table(rows: Sequence[RetrievalRow]) -> str:
    """What the rows over all queries cost beside what they give, those that give most first."""
    every = [r for r in rows if r.builder is None]
    cells = [
        [
            _short(r.name, NAME_WIDTH),
            "-" if r.width is None else str(r.width),
            _percent(r.recall_10.value),
            f"{r.mrr.value:.3f}",
            "-" if r.bytes is None else f"{r.bytes / 2**20:,.2f}",
            "-" if r.seconds is None else f"{r.seconds:,.2f}",
        ]
        for r in sorted(every, key=lambda r: -r.mrr.value)
    ]
    table = _table(["What it gives and costs", "Width", "R@10", "MRR", "MiB", "s"], {"": cells})
    return (
        f"{table}\nMiB: of what stands for the database. s: to rank for all queries; an exact "
        "search ranks at\nall widths at once."
    )


def builder_tables(rows: Sequence[RetrievalRow]) -> list[str]:
    """A table for each retriever: by builder, at every width, with the intervals."""
    tables = []
    for name in dict.fromkeys(r.name for r in rows):
        cells = []
        for r in [r for r in rows if r.name == name]:
            of = "all queries" if r.builder is None else f"builder {r.builder}"
            pairs = zip(_values(r), _ranges(r), strict=True)
            found = [f"{value} [{span}]" for value, span in pairs]
            cells.append([of, str(r.width), *found, str(r.queries)])
        head = [f"{_short(name, NAME_WIDTH)} by builder", "Width", *_heads(), "Queries"]
        tables.append(_table(head, {"": cells}))
    return tables


def index_table(indexes: Sequence[dict[str, Any]]) -> str:
    """What is told of approximate indexes, as `evaluation.index` gives it, each with its `name`."""
    cells = [
        [
            _short(told["name"], NAME_WIDTH),
            str(told["width"]),
            *(_percent(told[f"recall@{k}"]) for k in RECALLS),
            f"{told['bytes'] / 2**20:,.1f}",
            f"{told['seconds']:.2f}",
        ]
        for told in indexes
    ]
    recalls = [f"R@{k}" for k in RECALLS]
    table = _table(["Index, held against exact", "Width", *recalls, "MiB", "s"], {"": cells})
    return f"{table}\nR@k: of the exact first k, what share the index has among its own first k."


def human_table(found: dict[str, Any]) -> str:
    """What `evaluation.study.agreement.summary` found, beside the paper's study."""

    def row(name: str, of: dict[str, Any]) -> list[str]:
        shares = [of["families"].get(f, {}).get("value") for f in FAMILIES]
        shares += [of["macro"], of["micro"]["value"]]
        return [name, *map(_percent, shares), str(of["micro"]["n"])]

    own = [row(name, of) for name, of in found["accuracy"].items()]
    if found["majority"]:
        own.append(row("Majority vote", found["majority"]))
    times = [found["seconds"].get(f, {}).get("server") for f in FAMILIES]
    own.append(["Median seconds", *("-" if t is None else f"{t:.1f}" for t in times), "", "", ""])
    reference = [
        [r.name, *map(_printed, (r.event, r.time, r.window, r.macro)), "", items]
        for r, items in [*((r, "") for r in paper.HUMAN_ANNOTATORS), (paper.HUMAN_MAJORITY, "59")]
    ]
    seconds = [f"{paper.HUMAN_SECONDS[f]:.1f}" for f in FAMILIES]
    reference.append(["Median seconds", *seconds, "", "", ""])
    head = ["Human accuracy, %", *(f.capitalize() for f in FAMILIES), "Macro", "Micro", "Items"]
    table = _table(head, {"": own, "paper (59 items of three simulators)": reference})
    return "\n".join([table, *_human_notes(found)])


def _human_notes(found: dict[str, Any]) -> list[str]:
    depth = [f"{items} by {votes}" for votes, items in found["depth"].items()]
    kappa, alpha = found["fleiss_kappa"], found["krippendorff_alpha"]
    undecided = found["majority"]["undecided"] if found["majority"] else 0
    return [
        f"{found['judgments']:,} judgments of {found['items']:,} items; items by how many answered "
        f"them: {', '.join(depth)}.",
        f"Majority is more than half of an item's votes; items without one, counted wrong: "
        f"{undecided}.",
        f"Fleiss' kappa {_agreed(kappa['value'])} on the {kappa['items']} items that all "
        f"{len(found['annotators'])} answered (paper {paper.HUMAN_KAPPA:.2f} on 19).",
        f"Krippendorff's alpha {_agreed(alpha['value'])} on the {alpha['items']} items of two "
        "votes or more.",
        "Seconds are of pages that were loaded once.",
    ]


def _agreed(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.2f}"


def _heads() -> list[str]:
    return [*(f"R@{k}" for k in RECALLS), "MRR", "Median", "Tied"]


def _values(row: RetrievalRow) -> list[str]:
    found = row.measures
    recalls = [_percent(found[f"recall@{k}"].value) for k in RECALLS]
    median, ties = f"{row.median_rank.value:g}", _percent(row.tie_rate.value)
    return [*recalls, f"{row.mrr.value:.3f}", median, ties]


def _ranges(row: RetrievalRow) -> list[str]:
    found = row.measures
    recalls = [_range(found[f"recall@{k}"]) for k in RECALLS]
    mrr = f"{row.mrr.low:.2f}-{row.mrr.high:.2f}"
    median = f"{row.median_rank.low:.0f}-{row.median_rank.high:.0f}"
    return [*recalls, mrr, median, _range(row.tie_rate)]


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def _printed(percent: float | None) -> str:
    return "-" if percent is None else f"{percent:.1f}"


def _range(found: Interval | None) -> str:
    return "" if found is None else f"{100 * found.low:.0f}-{100 * found.high:.0f}"


def _table(head: list[str], parts: dict[str, list[list[str]]]) -> str:
    """Aligned columns, the first to the left, one part after the other under its label."""
    cells = [head, *(row for part in parts.values() for row in part)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [_line(head, widths)]
    rule = "-" * (sum(widths) + 2 * len(widths) - 2)
    for label, part in parts.items():
        lines += [rule, *([label] if label else []), *(_line(row, widths) for row in part)]
    return "\n".join([*lines, rule])


def _line(row: Iterable[str], widths: list[int]) -> str:
    first, *rest = row
    cells = [first.ljust(widths[0])]
    cells += [cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True)]
    return "  ".join(cells).rstrip()


def _short(name: str, width: int) -> str:
    return name if len(name) <= width else name[: width - 1] + "…"
