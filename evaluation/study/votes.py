"""The votes of a study, with every letter turned back into the candidate that stood there."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any


@dataclass(frozen=True)
class Vote:
    """One annotator's answer to one item.

    `choice` and `answer` are indices of candidates as the benchmark orders them, `letter` is where
    the chosen one stood on the annotator's page. Seconds run from the moment when everything was on
    the screen, by the server's clock and by the browser's; where a page was loaded more than once
    (`loads`), from the last time.
    """

    annotator: str
    item_id: str
    suite: str
    family: str
    subtype: str
    answer: int
    choice: int
    letter: str
    seconds: float
    client_seconds: float
    loads: int
    answered: str
    """When, UTC."""

    @property
    def right(self) -> bool:
        return self.choice == self.answer

    def to_row(self) -> dict[str, Any]:
        return {**asdict(self), "right": self.right}

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Vote:
        return cls(**{key: value for key, value in row.items() if key != "right"})


def votes_of(db: sqlite3.Connection) -> Iterator[Vote]:
    """Every vote of a study, in the order they were given; practice is none."""
    rows = db.execute(
        "SELECT annotator, item_id, suite, family, subtype, answer, choice, letter, "
        "answered - loaded AS seconds, client_seconds, loads, answered "
        "FROM turn JOIN item USING (item_id) "
        "WHERE NOT practice AND answered IS NOT NULL ORDER BY answered, token"
    )
    for row in rows:
        when = datetime.fromtimestamp(row["answered"], UTC).isoformat(timespec="seconds")
        yield Vote(**{**dict(row), "answered": when, "seconds": max(0.0, row["seconds"])})
