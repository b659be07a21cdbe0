"""A study's database: one SQLite file with its items, media, annotators and answers.

Each change is one transaction, so the file is always consistent. A change is on the disk before the
server replies to the browser. One server writes; an export may read at the same time.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dynapix.conf.errors import UserError
from dynapix.data.records import SelectionItem
from dynapix.evaluation.study.assignment import Assignment
from dynapix.evaluation.study.media import Medium

if TYPE_CHECKING:
    import pandas as pd

DATABASE = "study.sqlite"
VERSION = 2
MEDIA_PER_ITEM = 5
"""The prefix and four candidates."""

SCHEMA = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
-- place: position among the items, or among the practice items. answer: correct candidate index.
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
-- link: token of the unused link. session: hash of the session's secret. consented and begun: when
-- the pages before practice and before the items were left. rests: number of breaks that were left.
-- signed_in: when the session began.
CREATE TABLE annotator (
    name TEXT PRIMARY KEY, link TEXT NOT NULL UNIQUE, session TEXT UNIQUE,
    signed_in REAL, consented REAL, begun REAL, rests INTEGER NOT NULL DEFAULT 0
) STRICT;
-- rank and shown: `rank` and `order` of an `Assignment`.
CREATE TABLE plan (
    annotator TEXT NOT NULL REFERENCES annotator, item_id TEXT NOT NULL REFERENCES item,
    rank INTEGER NOT NULL, shown TEXT NOT NULL, PRIMARY KEY (annotator, item_id)
) STRICT;
-- An item that was opened for an annotator, and the answer. opened, loaded, answered: Unix times.
-- loads: number of times that the page was loaded. choice: chosen candidate index. closed: 1 when
-- the annotator has left the page.
CREATE TABLE turn (
    token TEXT PRIMARY KEY, annotator TEXT NOT NULL, item_id TEXT NOT NULL, opened REAL NOT NULL,
    loaded REAL, loads INTEGER NOT NULL DEFAULT 0, letter TEXT, choice INTEGER,
    client_seconds REAL, answered REAL, closed INTEGER NOT NULL DEFAULT 0,
    UNIQUE (annotator, item_id), FOREIGN KEY (annotator, item_id) REFERENCES plan
) STRICT;
CREATE INDEX turn_item ON turn (item_id);
"""


def create(
    path: Path,
    about: dict[str, str],
    items: Sequence[SelectionItem],
    practice: Sequence[SelectionItem],
    link_tokens: dict[str, str],
    assignments: Sequence[Assignment],
) -> sqlite3.Connection:
    """Create a study without media.

    Args:
        link_tokens: The token in the link of each annotator, by name.
        assignments: One for each annotator and item, practice items included.
    """
    # Only the owner may read the votes. SQLite's other files get the permissions of this file.
    path.touch(mode=0o600)
    path.chmod(0o600)
    db = _connect(path)
    db.execute("PRAGMA journal_mode = WAL")
    item_rows = [
        {**vars(item), "practice": is_practice, "place": place}
        for is_practice, chosen in ((False, items), (True, practice))
        for place, item in enumerate(chosen)
    ]
    plan_rows = [(a.annotator, a.item_id, a.rank, "".join(map(str, a.order))) for a in assignments]
    with transaction(db):
        for statement in SCHEMA.split(";"):
            db.execute(statement)
        db.executemany("INSERT INTO about VALUES (?, ?)", about.items())
        db.executemany(
            "INSERT INTO item VALUES (:item_id, :practice, :place, :suite, :family, :subtype, "
            ":question, :scene_id, :prefix_stop, :answer)",
            item_rows,
        )
        db.executemany("INSERT INTO annotator (name, link) VALUES (?, ?)", link_tokens.items())
        db.executemany("INSERT INTO plan VALUES (?, ?, ?, ?)", plan_rows)
        db.execute(f"PRAGMA user_version = {VERSION}")
    return db


def open_study(path: Path) -> sqlite3.Connection | None:
    """Return the database of a study; None if it does not exist or its creation was interrupted.

    Raises:
        UserError: The database is damaged, locked, unreadable or of another version.
    """
    if not path.exists():
        return None
    try:
        db = _connect(path)
        if not db.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]:
            return None
        version = db.execute("PRAGMA user_version").fetchone()[0]
        if version != VERSION:
            raise UserError(
                f"{path} has version {version}, but this release of DynaPix reads version "
                f"{VERSION}: resume the study with the release that created it, or start another "
                "study with run=NAME",
                code="unknown-version",
            )
        if (damage := db.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
            raise sqlite3.DatabaseError(damage)
    except sqlite3.OperationalError as error:
        raise UserError(
            f"{path} cannot be read ({error}): check its permissions, and that no other program "
            "uses it",
            code="unreadable-file",
        ) from error
    except sqlite3.DatabaseError as error:
        raise UserError(
            f"{path} is damaged ({error}): delete its folder, or start another study with run=NAME",
            code="damaged-file",
        ) from error
    return db


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


def read_about(db: sqlite3.Connection) -> dict[str, str]:
    """Return the name of the study's benchmark as `benchmark`, and its hash as `identity`."""
    return dict(tuple(row) for row in db.execute("SELECT key, value FROM about"))


def item_ids(db: sqlite3.Connection, practice: bool) -> list[str]:
    """Return the ids of the items or of the practice items, in the order of the study."""
    query = "SELECT item_id FROM item WHERE practice = ? ORDER BY place"
    return [row["item_id"] for row in db.execute(query, (practice,))]


def items_without_media(db: sqlite3.Connection) -> list[str]:
    """Return the ids of the items, practice included, that do not have all their media."""
    query = """
        SELECT item_id FROM item LEFT JOIN medium USING (item_id)
        GROUP BY item_id HAVING count(slot) <> ? ORDER BY place
    """
    return [row["item_id"] for row in db.execute(query, (MEDIA_PER_ITEM,))]


def add_media(db: sqlite3.Connection, item_id: str, media: Sequence[Medium]) -> None:
    rows = [(item_id, m.slot, m.kind, m.width, m.height, m.content) for m in media]
    with transaction(db):
        db.executemany("INSERT OR REPLACE INTO medium VALUES (?, ?, ?, ?, ?, ?)", rows)


def read_votes(db: sqlite3.Connection) -> pd.DataFrame:
    """Return the votes: a row for each annotator and answered item, without practice items, in the
    order of the answers.

    `answer` and `choice` are the indices of the correct and the chosen candidate in the item of the
    benchmark. `letter` is the chosen letter on the page. `right` is whether the choice is correct.
    `seconds` (the server's clock) and `client_seconds` (the browser's clock) start when all media
    of the page are loaded; if the page was loaded several times (`loads`), the last load counts.
    `answered` is an ISO 8601 time in UTC.
    """
    import pandas as pd

    votes = pd.read_sql(
        "SELECT annotator, item_id, scene_id, suite, family, subtype, answer, choice, letter, "
        "max(0.0, answered - loaded) AS seconds, client_seconds, loads, "
        "strftime('%Y-%m-%dT%H:%M:%S+00:00', CAST(answered AS INTEGER), 'unixepoch') AS answered "
        "FROM turn JOIN item USING (item_id) "
        "WHERE NOT practice AND turn.answered IS NOT NULL ORDER BY turn.answered, token",
        db,
    )
    return votes.assign(right=votes.choice == votes.answer)


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None, timeout=30)
    db.row_factory = sqlite3.Row
    db.execute("PRAGMA foreign_keys = ON")
    db.execute("PRAGMA synchronous = FULL")
    return db
