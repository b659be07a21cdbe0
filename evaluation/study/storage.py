"""A study's database: one SQLite file with its items, media, annotators and answers.

Each change is one transaction, so the file is always consistent. A change is on the disk before the
server replies to the browser. One server writes; an export may read at the same time.
"""

from __future__ import annotations

import secrets
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dynapix.conf.errors import UserError
from dynapix.data.records import SelectionItem
from dynapix.evaluation.study.assignment import Assignment
from dynapix.evaluation.study.media import Medium

if TYPE_CHECKING:
    import pandas as pd

DATABASE, LINKS_FILE = "study.sqlite", "links.txt"
VERSION = 3

SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
-- answer: correct candidate index.
CREATE TABLE item (
    item_id TEXT PRIMARY KEY, suite TEXT NOT NULL, family TEXT NOT NULL, subtype TEXT NOT NULL,
    question TEXT NOT NULL, scene_id TEXT NOT NULL, answer INTEGER NOT NULL
) STRICT;
CREATE TABLE medium (
    item_id TEXT NOT NULL REFERENCES item, slot INTEGER NOT NULL, kind TEXT NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, content BLOB NOT NULL,
    PRIMARY KEY (item_id, slot)
) STRICT;
-- secret: token in the personal link. consented: when the first page was left.
CREATE TABLE annotator (
    name TEXT PRIMARY KEY, secret TEXT NOT NULL UNIQUE, consented REAL
) STRICT;
-- rank and shown: `rank` and `order` of an `Assignment`.
CREATE TABLE plan (
    annotator TEXT NOT NULL REFERENCES annotator, item_id TEXT NOT NULL REFERENCES item,
    rank INTEGER NOT NULL, shown TEXT NOT NULL, PRIMARY KEY (annotator, item_id)
) STRICT;
-- An item that was opened for an annotator, and the answer. opened, loaded, answered: Unix times.
-- loads: number of times that the page was loaded. choice: chosen candidate index.
CREATE TABLE turn (
    token TEXT PRIMARY KEY, annotator TEXT NOT NULL, item_id TEXT NOT NULL, opened REAL NOT NULL,
    loaded REAL, loads INTEGER NOT NULL DEFAULT 0, letter TEXT, choice INTEGER, answered REAL,
    UNIQUE (annotator, item_id), FOREIGN KEY (annotator, item_id) REFERENCES plan
) STRICT;
CREATE INDEX turn_item ON turn (item_id);
"""


def new_token() -> str:
    return secrets.token_urlsafe(18)


def create(
    path: Path,
    about: dict[str, str],
    items: Sequence[SelectionItem],
    media: Iterable[tuple[str, Medium]],
    annotators: Sequence[str],
    assignments: Sequence[Assignment],
) -> None:
    """Create a study. Its file appears when it is complete.

    Args:
        media: The media of all items, each with the id of its item.
        assignments: One for each annotator and item.
    """
    partial = path.with_suffix(".partial")
    partial.unlink(missing_ok=True)
    # SQLite's other files get the permissions of this file.
    _create_private(partial)
    people = [(name, new_token()) for name in annotators]
    plan = [(a.annotator, a.item_id, a.rank, "".join(map(str, a.order))) for a in assignments]
    with closing(_connect(partial)) as db, transaction(db):
        for statement in SCHEMA.split(";"):
            db.execute(statement)
        db.executemany("INSERT INTO about VALUES (?, ?)", about.items())
        db.executemany(
            "INSERT INTO item VALUES (:item_id, :suite, :family, :subtype, :question, :scene_id, "
            ":answer)",
            map(vars, items),
        )
        db.executemany(
            "INSERT INTO medium VALUES (?, ?, ?, ?, ?, ?)",
            ((item_id, m.slot, m.kind, m.width, m.height, m.content) for item_id, m in media),
        )
        db.executemany("INSERT INTO annotator (name, secret) VALUES (?, ?)", people)
        db.executemany("INSERT INTO plan VALUES (?, ?, ?, ?)", plan)
        db.execute(f"PRAGMA user_version = {VERSION}")
    partial.replace(path)


def open_study(path: Path) -> sqlite3.Connection:
    """Return the database of a study.

    Raises:
        UserError: The database is missing, damaged, locked, unreadable or of another version.
    """
    if not path.exists():
        raise UserError(
            f"{path} does not exist: start a study with python -m evaluation.study",
            code="missing-run",
        )
    try:
        db = _connect(path)
        version = db.execute("PRAGMA user_version").fetchone()[0]
        damage = db.execute("PRAGMA quick_check(1)").fetchone()[0]
        db.execute("PRAGMA journal_mode = WAL")
        if damage != "ok":
            raise sqlite3.DatabaseError(damage)
    except sqlite3.DatabaseError as error:
        raise UserError(
            f"{path} cannot be read ({error}): check its permissions, and that no other program "
            "uses it, or start another study with run=NAME",
            code="damaged-file",
        ) from error
    if version != VERSION:
        raise UserError(
            f"{path} has version {version}, but this release of DynaPix reads version {VERSION}: "
            "resume the study with the release that created it, or start another study with "
            "run=NAME",
            code="unknown-version",
        )
    return db


def write_links(db: sqlite3.Connection, path: Path, address: str) -> dict[str, str]:
    """Write the link of each annotator to a file that only its owner can read. Return the links by
    annotator."""
    rows = db.execute("SELECT name, secret FROM annotator ORDER BY rowid")
    links = {row["name"]: f"{address}/link/{row['secret']}" for row in rows}
    _create_private(path)
    path.write_text("".join(f"{name}  {link}\n" for name, link in links.items()))
    return links


@contextmanager
def transaction(db: sqlite3.Connection, read_only: bool = False) -> Iterator[None]:
    """Commit the changes of the block at its end; after an exception, roll all of them back. A
    read-only transaction does not block writers."""
    db.execute("BEGIN" if read_only else "BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        db.execute("ROLLBACK")
        raise
    db.execute("COMMIT")


def read_votes(db: sqlite3.Connection) -> pd.DataFrame:
    """Return the votes: a row for each annotator and answered item, in the order of the answers.

    `answer` and `choice` are the indices of the correct and the chosen candidate in the item of the
    benchmark. `letter` is the chosen letter on the page. `right` is whether the choice is correct.
    `seconds` begin when all media of the page are loaded; if the page was loaded several times
    (`loads`), the last load counts. `answered` is an ISO 8601 time in UTC.
    """
    import pandas as pd

    votes = pd.read_sql(
        "SELECT annotator, item_id, scene_id, suite, family, subtype, answer, choice, letter, "
        "max(0.0, answered - loaded) AS seconds, loads, "
        "strftime('%Y-%m-%dT%H:%M:%S+00:00', CAST(answered AS INTEGER), 'unixepoch') AS answered "
        "FROM turn JOIN item USING (item_id) "
        "WHERE turn.answered IS NOT NULL ORDER BY turn.answered, token",
        db,
    )
    return votes.assign(right=votes.choice == votes.answer)


def _create_private(path: Path) -> None:
    """Create a file, unless it exists, that only its owner may read."""
    path.touch(mode=0o600)
    path.chmod(0o600)


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, timeout=30)
    db.row_factory = sqlite3.Row
    db.execute("PRAGMA foreign_keys = ON")
    db.execute("PRAGMA synchronous = FULL")
    return db
