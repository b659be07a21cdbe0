"""What models said to which items, read from the runs of evaluation.select, and whether runs
measured the same items."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from functools import cached_property

from conf.errors import UserError
from conf.schema.commands import CONTROLS
from evaluation.page.gathering import Finished, json_lines
from evaluation.page.rows import Measured
from train.choice import Choice, parse

NAMED = 3
"""Items that are named of those that one run alone measured."""

Asked = tuple[str, str | None]
"""How a model was asked: the mode, and the control by which the items were shown."""


@dataclass(frozen=True)
class Said:
    """What a model said to an item; `cut` where it was stopped before its end."""

    text: str
    cut: bool

    @cached_property
    def choice(self) -> Choice:
        return parse(self.text, cut=self.cut)


def control_of(benchmark: str) -> str | None:
    """The control in a row's benchmark, such as "tiny, candidate_only"."""
    return next((part for part in benchmark.split(", ")[1:] if part in CONTROLS), None)


def answers_of(run: Finished) -> dict[Asked, dict[str, Said]]:
    """What the model of a run said, by item; what it said before it was asked otherwise is left
    out, as are lines that a kill tore."""
    controls: dict[str, str | None] = {}
    by_key: dict[tuple[str, str | None], dict[str, Said]] = {}
    for row in json_lines(run.folder / "answers.jsonl"):
        if "asked" in row:
            controls[row["key"]] = row["asked"].get("control")
        elif {"item_id", "mode", "text"} <= row.keys():
            found = by_key.setdefault((row["mode"], row.get("key")), {})
            found[row["item_id"]] = Said(row["text"], row.get("cut", False))
    plain = run.config.get("control")
    return {(mode, controls.get(key, plain)): said for (mode, key), said in by_key.items()}


def check_same_items(rows: Sequence[Measured], ids: Sequence[Set[str] | None]) -> None:
    """Rows of one benchmark stand in one table, so they must be of the same items.

    Args:
        ids: of each row its items, or None where they are not known and their number has to do.

    Raises:
        UserError: two runs measured different items; the difference is told.
    """
    first: dict[str, int] = {}
    for k, m in enumerate(rows):
        j = first.setdefault(m.benchmark, k)
        pair = (rows[j].run.folder, m.run.folder)
        counts = (rows[j].row.n, m.row.n)
        if ids[j] is None or ids[k] is None:
            told = "" if counts[0] == counts[1] else f"{counts[0]:,} and {counts[1]:,} of them"
        else:
            apart = (ids[j] - ids[k], ids[k] - ids[j])
            told = " and ".join(
                f"{len(only):,} only in {folder} (such as {', '.join(sorted(only)[:NAMED])})"
                for folder, only in zip(pair, apart, strict=True)
                if only
            )
        if told:
            raise UserError(
                f"{pair[0]} and {pair[1]} measured different items of {m.benchmark}, which do "
                f"not belong into one table: {told}. Name the runs of one item set with runs=[...]"
            )


def check_same_rankings(rows: Sequence[Measured]) -> None:
    """The same of the queries and the database of retrieval rows, whose numbers have to do.

    Raises:
        UserError: two runs ranked other numbers of frames for other numbers of queries.
    """
    first: dict[tuple, Measured] = {}
    for m in rows:
        row, other = m.row, first.setdefault((m.benchmark, m.row.builder), m)
        theirs = other.row
        if (theirs.queries, theirs.frames) != (row.queries, row.frames):
            raise UserError(
                f"{other.run.folder} ranked {theirs.frames:,} frames of {m.benchmark} for "
                f"{theirs.queries:,} queries and {m.run.folder} {row.frames:,} for "
                f"{row.queries:,}, which do not belong into one table: name the runs of one test "
                "with runs=[...]"
            )
