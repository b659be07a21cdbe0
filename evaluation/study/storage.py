"""A study's database: one SQLite file with its items, media, accounts and answers.

It is whole at every moment: each change is one transaction, on the disk before anybody is told. One
server writes; an export may read beside it.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from conf.errors import UserError
from data.records import SelectionItem
from evaluation.study.assignment import Planned
from evaluation.study.media import Medium

DATABASE = "study.sqlite"
APPLICATION = 0x44795078
"""SQLite's mark of whose database a file is."""
VERSION = 1
SLOTS = 5
"""Media of an item."""

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


def create(
    path: Path,
    about: dict[str, str],
    items: Sequence[SelectionItem],
    practice: Sequence[SelectionItem],
    links: dict[str, str],
    plan: Sequence[Planned],
) -> sqlite3.Connection:
    """A new study, still without media. `links` holds each annotator's first link; `plan` covers
    the items of practice too."""
    # SQLite gives the files that it keeps beside a database the mode of that.
    os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600))
    path.chmod(0o600)
    db = _connect(path)
    db.execute("PRAGMA journal_mode = WAL")
    with transaction(db):
        for statement in SCHEMA.split(";"):
            db.execute(statement)
        db.executemany("INSERT INTO about VALUES (?, ?)", about.items())
        asked = [(False, i) for i in items] + [(True, i) for i in practice]
        rows = [_item_row(practised, k, item) for k, (practised, item) in enumerate(asked)]
        db.executemany(f"INSERT INTO item VALUES ({', '.join('?' * 10)})", rows)
        db.executemany("INSERT INTO annotator (name, link) VALUES (?, ?)", links.items())
        planned = [(p.annotator, p.item_id, p.rank, "".join(map(str, p.order))) for p in plan]
        db.executemany("INSERT INTO plan VALUES (?, ?, ?, ?)", planned)
        db.execute(f"PRAGMA application_id = {APPLICATION}")
        db.execute(f"PRAGMA user_version = {VERSION}")
    return db


def begun(path: Path) -> bool:
    """Whether a file holds a study; one whose creation was killed holds nothing yet."""
    return path.exists() and path.stat().st_size > 0 and _tables(path) != 0


def open_study(path: Path) -> sqlite3.Connection:
    """The database of a study that was begun.

    Raises:
        UserError: it is damaged, of another version, or no study.
    """
    anew = "delete its folder, or begin a study of another name with run=NAME"
    try:
        db = _connect(path)
        whose = db.execute("PRAGMA application_id").fetchone()[0]
        version = db.execute("PRAGMA user_version").fetchone()[0]
        if whose != APPLICATION:
            raise UserError(f"{path} is no database of a study: {anew}")
        if version != VERSION:
            raise UserError(
                f"{path} is a study of version {version}, this is version {VERSION}: go on with "
                "it in the release that began it, or begin another with run=NAME"
            )
        if (found := db.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
            raise UserError(f"{path} is damaged ({found}): {anew}")
    except sqlite3.DatabaseError as error:
        raise UserError(f"{path} is damaged or no database of a study ({error}): {anew}") from error
    return db


@contextmanager
def transaction(db: sqlite3.Connection, reads: bool = False) -> Iterator[None]:
    """All that happens within, or nothing of it; what only `reads` holds up nobody who writes."""
    db.execute("BEGIN" if reads else "BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        db.execute("ROLLBACK")
        raise
    db.execute("COMMIT")


def about(db: sqlite3.Connection) -> dict[str, str]:
    """What was noted of the study when it began."""
    return dict(tuple(row) for row in db.execute("SELECT key, value FROM about"))


def annotators(db: sqlite3.Connection) -> list[str]:
    return [row["name"] for row in db.execute("SELECT name FROM annotator ORDER BY rowid")]


def item_ids(db: sqlite3.Connection, practice: bool) -> list[str]:
    """The study's items, in the order that they were chosen in."""
    asked = "SELECT item_id FROM item WHERE practice = ? ORDER BY place"
    return [row["item_id"] for row in db.execute(asked, (practice,))]


def without_media(db: sqlite3.Connection) -> list[str]:
    """Items of which something to show is missing."""
    counted = """
        SELECT item_id FROM item LEFT JOIN medium USING (item_id)
        GROUP BY item_id HAVING count(slot) <> ? ORDER BY place
    """
    return [row["item_id"] for row in db.execute(counted, (SLOTS,))]


def add_media(db: sqlite3.Connection, item_id: str, media: Sequence[Medium]) -> None:
    rows = [(item_id, m.slot, m.kind, m.width, m.height, m.content) for m in media]
    with transaction(db):
        db.executemany("INSERT OR REPLACE INTO medium VALUES (?, ?, ?, ?, ?, ?)", rows)


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, timeout=30)
    db.row_factory = sqlite3.Row
    db.execute("PRAGMA foreign_keys = ON")
    db.execute("PRAGMA synchronous = FULL")
    return db


def _tables(path: Path) -> int:
    try:
        with closing(_connect(path)) as db:
            return db.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    except sqlite3.DatabaseError:
        return -1


def _item_row(practice: bool, place: int, item: SelectionItem) -> tuple:
    cell = (item.suite, item.family, item.subtype, item.question)
    moment = (item.scene_id, item.prefix_stop, item.answer)
    return (item.item_id, practice, place, *cell, *moment)
