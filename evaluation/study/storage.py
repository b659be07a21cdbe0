"""A study's database: one SQLite file with its items, media, annotators and answers.

Every change is one transaction that is on disk before the client is answered, so that the file is
consistent at any time. One server writes; an export may read at the same time.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from conf.errors import UserError
from data.records import SelectionItem
from evaluation.study.assignment import Assignment
from evaluation.study.media import Medium

DATABASE = "study.sqlite"
APPLICATION_ID = 0x44795078
"""Marks the file as a study's in SQLite's header."""
VERSION = 1
MEDIA_PER_ITEM = 5

SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE item (
    item_id TEXT PRIMARY KEY, practice INTEGER NOT NULL, place INTEGER NOT NULL,
    suite TEXT NOT NULL, family TEXT NOT NULL, subtype TEXT NOT NULL, question TEXT NOT NULL,
    scene_id TEXT NOT NULL, prefix_stop INTEGER NOT NULL, answer INTEGER NOT NULL
) STRICT;
CREATE TABLE medium (
    item_id TEXT NOT NULL REFERENCES item, slot INTEGER NOT NULL, kind TEXT NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, content BLOB NOT NULL,
    PRIMARY KEY (item_id, slot)
) STRICT;
CREATE TABLE annotator (
    name TEXT PRIMARY KEY, link TEXT NOT NULL UNIQUE, session TEXT UNIQUE, form_key TEXT,
    consented REAL, begun REAL, rests INTEGER NOT NULL DEFAULT 0
) STRICT;
CREATE TABLE plan (
    annotator TEXT NOT NULL REFERENCES annotator, item_id TEXT NOT NULL REFERENCES item,
    rank INTEGER NOT NULL, shown TEXT NOT NULL, PRIMARY KEY (annotator, item_id)
) STRICT;
CREATE TABLE turn (
    token TEXT PRIMARY KEY, annotator TEXT NOT NULL, item_id TEXT NOT NULL, opened REAL NOT NULL,
    loaded REAL, loads INTEGER NOT NULL DEFAULT 0, letter TEXT, choice INTEGER,
    client_seconds REAL, answered REAL, closed INTEGER NOT NULL DEFAULT 0,
    UNIQUE (annotator, item_id), FOREIGN KEY (annotator, item_id) REFERENCES plan
) STRICT;
CREATE INDEX turn_item ON turn (item_id);
CREATE TABLE name (
    token TEXT PRIMARY KEY, turn TEXT NOT NULL REFERENCES turn, slot INTEGER NOT NULL,
    UNIQUE (turn, slot)
) STRICT;
"""


@dataclass(frozen=True)
class Vote:
    """One annotator's answer to one item.

    Seconds run from the moment when the page was completely visible; if it was loaded more than
    once (`loads`), from the last time.

    Attributes:
        answer, choice: Indices of the correct and the chosen candidate in the benchmark's order.
        letter: The letter at which the chosen candidate stood.
        seconds, client_seconds: By the server's and by the browser's clock.
        answered: Time of the answer, UTC.
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

    @property
    def right(self) -> bool:
        return self.choice == self.answer

    def to_row(self) -> dict[str, Any]:
        return {**asdict(self), "right": self.right}

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Vote:
        return cls(**{key: value for key, value in row.items() if key != "right"})


def create(
    path: Path,
    about: dict[str, str],
    items: Sequence[SelectionItem],
    practice: Sequence[SelectionItem],
    links: dict[str, str],
    assignments: Sequence[Assignment],
) -> sqlite3.Connection:
    """A new study without media.

    Args:
        links: Each annotator's first link.
        assignments: Those of the items and of the practice items.
    """
    # SQLite gives its side files the mode of the database.
    os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600))
    path.chmod(0o600)
    db = _connect(path)
    db.execute("PRAGMA journal_mode = WAL")
    all_items = [*((False, item) for item in items), *((True, item) for item in practice)]
    item_rows = [
        (
            i.item_id, is_practice, place, i.suite, i.family, i.subtype, i.question, i.scene_id,
            i.prefix_stop, i.answer,
        )
        for place, (is_practice, i) in enumerate(all_items)
    ]  # fmt: skip
    plan_rows = [(a.annotator, a.item_id, a.rank, "".join(map(str, a.order))) for a in assignments]
    with transaction(db):
        for statement in SCHEMA.split(";"):
            db.execute(statement)
        db.executemany("INSERT INTO about VALUES (?, ?)", about.items())
        db.executemany(f"INSERT INTO item VALUES ({', '.join('?' * 10)})", item_rows)
        db.executemany("INSERT INTO annotator (name, link) VALUES (?, ?)", links.items())
        db.executemany("INSERT INTO plan VALUES (?, ?, ?, ?)", plan_rows)
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {VERSION}")
    return db


def exists(path: Path) -> bool:
    """Whether a file holds a study. If the creation was killed, the file has no tables yet."""
    if not path.exists() or path.stat().st_size == 0:
        return False
    try:
        with closing(_connect(path)) as db:
            return db.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0] > 0
    except sqlite3.DatabaseError:
        return True


def open_study(path: Path) -> sqlite3.Connection:
    """The database of an existing study.

    Raises:
        UserError: it is damaged, of another version, or not a study.
    """
    remedy = "delete its folder, or start another study with run=NAME"
    try:
        db = _connect(path)
        application = db.execute("PRAGMA application_id").fetchone()[0]
        version = db.execute("PRAGMA user_version").fetchone()[0]
        if application != APPLICATION_ID:
            raise UserError(f"{path} is not a study's database: {remedy}", code="not-a-study")
        if version != VERSION:
            raise UserError(
                f"{path} has the format {version} of another release, this one reads {VERSION}: "
                "resume it in that release, or start another study with run=NAME",
                code="unknown-version",
            )
        if (damage := db.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
            raise UserError(f"{path} is damaged ({damage}): {remedy}", code="damaged-file")
    except sqlite3.DatabaseError as error:
        raise UserError(f"{path} is damaged ({error}): {remedy}", code="damaged-file") from error
    return db


@contextmanager
def transaction(db: sqlite3.Connection, read_only: bool = False) -> Iterator[None]:
    """Run the block completely or not at all. Read-only transactions do not block writers."""
    db.execute("BEGIN" if read_only else "BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        db.execute("ROLLBACK")
        raise
    db.execute("COMMIT")


def read_about(db: sqlite3.Connection) -> dict[str, str]:
    """The name and the identity of the study's benchmark."""
    return dict(tuple(row) for row in db.execute("SELECT key, value FROM about"))


def annotator_names(db: sqlite3.Connection) -> list[str]:
    return [row["name"] for row in db.execute("SELECT name FROM annotator ORDER BY rowid")]


def item_ids(db: sqlite3.Connection, practice: bool) -> list[str]:
    """The ids of the items or of the practice items, in the order of their choice."""
    query = "SELECT item_id FROM item WHERE practice = ? ORDER BY place"
    return [row["item_id"] for row in db.execute(query, (practice,))]


def items_without_media(db: sqlite3.Connection) -> list[str]:
    """The ids of items that lack a medium."""
    query = """
        SELECT item_id FROM item LEFT JOIN medium USING (item_id)
        GROUP BY item_id HAVING count(slot) <> ? ORDER BY place
    """
    return [row["item_id"] for row in db.execute(query, (MEDIA_PER_ITEM,))]


def add_media(db: sqlite3.Connection, item_id: str, media: Sequence[Medium]) -> None:
    rows = [(item_id, m.slot, m.kind, m.width, m.height, m.content) for m in media]
    with transaction(db):
        db.executemany("INSERT OR REPLACE INTO medium VALUES (?, ?, ?, ?, ?, ?)", rows)


def read_votes(db: sqlite3.Connection) -> Iterator[Vote]:
    """The votes in temporal order, without practice."""
    rows = db.execute(
        "SELECT annotator, item_id, suite, family, subtype, answer, choice, letter, "
        "answered - loaded AS seconds, client_seconds, loads, answered "
        "FROM turn JOIN item USING (item_id) "
        "WHERE NOT practice AND answered IS NOT NULL ORDER BY answered, token"
    )
    for row in rows:
        time = datetime.fromtimestamp(row["answered"], UTC).isoformat(timespec="seconds")
        yield Vote(**{**dict(row), "answered": time, "seconds": max(0.0, row["seconds"])})


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, timeout=30)
    db.row_factory = sqlite3.Row
    db.execute("PRAGMA foreign_keys = ON")
    db.execute("PRAGMA synchronous = FULL")
    return db
