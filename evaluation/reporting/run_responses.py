"""What models said to which items and embedders made of them, read from the runs' folders, and
whether runs measured the same items."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from conf.errors import UserError
from data.records import LETTERS
from evaluation.metrics.significance import check_same_items
from evaluation.reporting.measurements import Measured
from evaluation.reporting.runs import Finished, json_lines, unreadable
from models.student.answer_parser import ParsedAnswer, Reason, parse_choice

Asked = tuple[str, str | None]
"""How items were asked: the mode, or the embedder that chose, and the control by which they were
shown."""


@dataclass(frozen=True)
class Said:
    """What a model said to an item; `cut` where it was stopped before its end."""

    text: str
    cut: bool

    @cached_property
    def choice(self) -> ParsedAnswer:
        return parse_choice(self.text, cut=self.cut)

    def credit(self, letter: str) -> float:
        """What it is worth where `letter` is right."""
        return float(self.choice.letter == letter)


@dataclass(frozen=True)
class Scored:
    """How near an embedder finds an item's candidates to its query, by letter; None where it has no
    score."""

    scores: Mapping[str, float | None]
    cut: bool = False

    @property
    def text(self) -> str:
        told = {x: "no score" if s is None else f"{s:.4f}" for x, s in self.scores.items()}
        return ", ".join(f"{letter} {s}" for letter, s in told.items())

    @property
    def choice(self) -> ParsedAnswer:
        nearest = self._nearest
        return ParsedAnswer(nearest) if len(nearest) == 1 else ParsedAnswer(None, Reason.SEVERAL)

    def credit(self, letter: str) -> float:
        """A tie among m is worth 1/m."""
        return (letter in self._nearest) / max(1, len(self._nearest))

    @property
    def _nearest(self) -> str:
        """The letters of the candidates that score highest."""
        known = {x: s for x, s in self.scores.items() if s is not None}
        return "".join(x for x, s in known.items() if s == max(known.values()))


def answers_of(run: Finished) -> dict[Asked, dict[str, Said | Scored]]:
    """What was said or chosen in a run, by item: what its report is of. What a model said when it
    was asked otherwise is left out, as are lines that a kill tore.

    Raises:
        UserError: the report is of another version.
    """
    return _scored(run) if run.kind == "similarity" else _said(run)


def _scored(run: Finished) -> dict[Asked, dict[str, Scored]]:
    found: dict[Asked, dict[str, Scored]] = {}
    try:
        for row in json_lines(run.folder / "scores.jsonl"):
            scores = dict(zip(LETTERS, row["scores"], strict=True))
            found.setdefault((row["by"], None), {})[row["item_id"]] = Scored(scores)
    except (KeyError, TypeError, ValueError) as error:
        raise unreadable(run.folder, "scores.jsonl") from error
    return found


def _said(run: Finished) -> dict[Asked, dict[str, Said]]:
    try:
        asked = {key: (mode, control) for mode, control, key in run.report["asked"]}
        said: dict[Asked, dict[str, Said]] = {how: {} for how in asked.values()}
        for row in json_lines(run.folder / "answers.jsonl"):
            if "text" in row and row["key"] in asked:
                said[asked[row["key"]]][row["item_id"]] = Said(str(row["text"]), bool(row["cut"]))
    except (KeyError, TypeError, ValueError) as error:
        raise unreadable(run.folder) from error
    return said


def check_same_build(runs: Iterable[Finished]) -> None:
    """A benchmark that was built anew under its name may have other items by the same ids.

    Raises:
        UserError: two runs measured different builds of a benchmark.
    """
    first: dict[str, tuple[str, Finished]] = {}
    for run in runs:
        try:
            name, build = run.config["benchmark"]["name"], run.report["build"]
        except (KeyError, TypeError) as error:
            raise unreadable(run.folder) from error
        known, other = first.setdefault(name, (build, run))
        if known != build:
            raise UserError(
                f"{other.folder} and {run.folder} measured different builds of benchmark {name}: "
                "measure one of them again (run=NAME), or leave it out with runs=[...]"
            )


def check_rows_share_items(
    rows: Sequence[Measured], ids: Sequence[Mapping[str, object] | None]
) -> None:
    """Rows of one benchmark stand in one table, so they must be of the same items.

    Args:
        ids: of each row its items, or None where they are not known and their number has to do.

    Raises:
        UserError: two runs measured different items; the difference is told.
    """
    first: dict[str, int] = {}
    # One whose items are known tells most.
    for k in sorted(range(len(rows)), key=lambda k: ids[k] is None):
        m = rows[k]
        j = first.setdefault(m.items, k)
        names = (str(rows[j].run.folder), str(m.run.folder))
        try:
            if ids[j] is not None and ids[k] is not None:
                check_same_items(ids[j], ids[k], names)
            elif rows[j].row.n != m.row.n:
                told = f"{names[0]} and {names[1]} answered {rows[j].row.n:,} and {m.row.n:,} items"
                raise UserError(f"{told}: compare runs of the same items")
            elif (drawn := _drawn(rows[j].run)) != _drawn(m.run):
                told = f"{names[0]} and {names[1]} answered items of limit and seed {drawn} and "
                raise UserError(f"{told}{_drawn(m.run)}: compare runs of the same items")
        except UserError as error:
            raise UserError(f"{error}, which runs=[...] chooses") from error


def _drawn(run: Finished) -> tuple[int, int] | None:
    """The limit and the seed by which a run's items were drawn; None where they are all of them."""
    limit = run.config.get("limit")
    return None if limit is None else (limit, run.config.get("seed", 0))


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
