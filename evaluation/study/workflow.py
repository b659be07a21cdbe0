"""The stages of an annotator: consent, practice, items with breaks between them, and the end.

The database alone determines the stage, so that nothing is lost if a page is closed or the server
stops. A request that does not belong to the current stage changes nothing.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass
from typing import Any

from dynapix.data.records import LETTERS
from dynapix.evaluation.study.auth import new_token
from dynapix.evaluation.study.media import PREFIX
from dynapix.evaluation.study.storage import transaction

ABANDONED_SECONDS = 3600.0
"""An item that was opened counts as a vote in `NEXT_ITEM` for this time, even without an answer."""
TURN = "SELECT * FROM turn JOIN plan USING (annotator, item_id) JOIN item USING (item_id)"
NEXT_ITEM = """
WITH
    own AS (
        SELECT item.*, rank, token FROM plan JOIN item USING (item_id)
        LEFT JOIN turn USING (annotator, item_id) WHERE annotator = ? AND practice = ?
    ),
    progress AS (SELECT family, 1.0 * count(token) / count(*) AS share FROM own GROUP BY family),
    waiting AS (
        SELECT *, min(prefix_stop) OVER (PARTITION BY scene_id) AS earliest
        FROM own WHERE token IS NULL
    ),
    vote AS (
        SELECT item_id, count(*) AS votes FROM turn
        WHERE answered IS NOT NULL OR opened > ? GROUP BY item_id
    )
SELECT item_id FROM waiting JOIN progress USING (family) LEFT JOIN vote USING (item_id)
WHERE prefix_stop = earliest ORDER BY share, coalesce(votes, 0), rank LIMIT 1
"""
"""Selects the item that is opened next for an annotator.

It is of the family of which the annotator has seen the smallest share, so that even the answers of
an annotator who stops early cover the families in proportion. Within a family, the items with the
fewest votes come first. Within a scene, the item with the earliest prefix comes first, because a
later prefix shows what happens after an earlier one.
"""


@dataclass(frozen=True)
class Stage:
    """An annotator's current stage.

    Attributes:
        page: consent, practice, feedback (on a practice item), ready, item, rest, next (no item is
            open) or done.
        key: Identifies the page in its form. The key of an item is its token, which is random.
        number: Number of the item on the page, or else of the answered items.
        total: Number of the practice items during practice, otherwise of the items.
    """

    page: str
    key: str = ""
    number: int = 0
    total: int = 0


def current_stage(db: sqlite3.Connection, annotator: sqlite3.Row, rest_every: int) -> Stage:
    """Return an annotator's stage. It changes nothing, because browsers also load pages that nobody
    sees."""
    if annotator["consented"] is None:
        return Stage("consent", "consent")
    name = annotator["name"]
    with transaction(db, read_only=True):
        answered, total = _progress(db, name, practice=True)
        if unread := [turn["token"] for turn in answered if not turn["closed"]]:
            return Stage("feedback", unread[0], len(answered), total)
        if len(answered) < total:
            return _item_stage(db, name, True, len(answered) + 1, total)
        answered, total = _progress(db, name, practice=False)
        done = len(answered)
        if annotator["begun"] is None:
            return Stage("ready", "ready", total=total)
        if done == total:
            return Stage("done", number=done, total=total)
        rests, items_since = divmod(done, rest_every)
        if rests > annotator["rests"] and not items_since:
            return Stage("rest", f"rest-{rests}", done, total)
        return _item_stage(db, name, False, done + 1, total)


def _item_stage(
    db: sqlite3.Connection, name: str, practice: bool, number: int, total: int
) -> Stage:
    if token := _open_token(db, name, practice):
        return Stage("practice" if practice else "item", token, number, total)
    return Stage("next", f"next-{'practice' if practice else 'item'}", number, total)


def open_next_item(db: sqlite3.Connection, name: str, rest_every: int) -> None:
    """Open the next item of an annotator whose stage is `next`; otherwise, change nothing."""
    annotator = db.execute("SELECT * FROM annotator WHERE name = ?", (name,)).fetchone()
    stage = current_stage(db, annotator, rest_every)
    if stage.page == "next":
        with transaction(db):
            _open_item(db, name, practice=stage.key == "next-practice")


def withdraw(db: sqlite3.Connection, name: str) -> None:
    """Delete an annotator with all answers."""
    with transaction(db):
        for table, column in (("turn", "annotator"), ("plan", "annotator"), ("annotator", "name")):
            db.execute(f"DELETE FROM {table} WHERE {column} = ?", (name,))


def _progress(db: sqlite3.Connection, name: str, practice: bool) -> tuple[list[sqlite3.Row], int]:
    """Return the rows of an annotator's answered items, and the number of all items."""
    turns = db.execute(
        f"{TURN} WHERE annotator = ? AND practice = ? AND answered IS NOT NULL", (name, practice)
    )
    total = db.execute("SELECT count(*) FROM item WHERE practice = ?", (practice,))
    return turns.fetchall(), total.fetchone()[0]


def leave_page(db: sqlite3.Connection, annotator: sqlite3.Row, key: str, rest_every: int) -> None:
    """Leave the page with this key, if it is the current page and has no open question."""
    stage = current_stage(db, annotator, rest_every)
    changes = {
        "consent": ("consented", time.time()),
        "ready": ("begun", time.time()),
        "rest": ("rests", stage.number // rest_every),
    }
    if stage.key != key:
        return
    with transaction(db):
        if stage.page == "feedback":
            db.execute("UPDATE turn SET closed = 1 WHERE token = ?", (key,))
        elif stage.page in changes:
            column, value = changes[stage.page]
            query = f"UPDATE annotator SET {column} = ? WHERE name = ?"
            db.execute(query, (value, annotator["name"]))


def record_loaded(db: sqlite3.Connection, name: str, token: str) -> bool:
    """Start the clock of an open item, whose media are loaded. Return False if the item is not
    open."""
    with transaction(db):
        changed = db.execute(
            "UPDATE turn SET loaded = ?, loads = loads + 1 "
            "WHERE token = ? AND annotator = ? AND answered IS NULL",
            (time.time(), token, name),
        )
    return changed.rowcount == 1


def record_answer(
    db: sqlite3.Connection, name: str, token: str, letter: str, client_seconds: float
) -> bool:
    """Store the answer to an item. Return False if the item is not open or not loaded."""
    with transaction(db):
        turn = db.execute(
            f"{TURN} WHERE token = ? AND annotator = ? AND answered IS NULL AND loaded IS NOT NULL",
            (token, name),
        ).fetchone()
        if turn is None:
            return False
        choice = int(turn["shown"][LETTERS.index(letter)])
        db.execute(
            "UPDATE turn SET letter = ?, choice = ?, client_seconds = ?, answered = ?, closed = ? "
            "WHERE token = ?",
            (letter, choice, client_seconds, time.time(), not turn["practice"], token),
        )
    return True


def load_question(db: sqlite3.Connection, token: str) -> dict[str, Any]:
    """Return the `text` of an item's question, the `width` and `height` of its media in pixels, and
    the `correct` and the `chosen` letter if it is an answered practice item (otherwise None)."""
    turn = db.execute(f"{TURN} WHERE token = ?", (token,)).fetchone()
    query = "SELECT width, height FROM medium WHERE item_id = ? AND slot = ?"
    size = dict(db.execute(query, (turn["item_id"], PREFIX)).fetchone())
    letters = {"correct": None, "chosen": None}
    if turn["practice"] and turn["answered"] is not None:
        correct = LETTERS[turn["shown"].index(str(turn["answer"]))]
        letters = {"correct": correct, "chosen": turn["letter"]}
    return {"text": turn["question"], **size, **letters}


def load_medium(db: sqlite3.Connection, name: str, token: str, place: str) -> sqlite3.Row | None:
    """Return the kind and content of a medium of the annotator's current page; None if there is no
    such medium. `place` is "prefix" or the letter of a candidate."""
    query = f"{TURN} WHERE token = ? AND annotator = ? AND NOT closed"
    turn = db.execute(query, (token, name)).fetchone()
    if turn is None or place not in ("prefix", *LETTERS):
        return None
    slot = PREFIX if place == "prefix" else int(turn["shown"][LETTERS.index(place)])
    query = "SELECT kind, content FROM medium WHERE item_id = ? AND slot = ?"
    return db.execute(query, (turn["item_id"], slot)).fetchone()


def _open_token(db: sqlite3.Connection, name: str, practice: bool) -> str | None:
    turn = db.execute(
        f"{TURN} WHERE annotator = ? AND practice = ? AND answered IS NULL", (name, practice)
    ).fetchone()
    return turn and turn["token"]


def _open_item(db: sqlite3.Connection, name: str, practice: bool) -> None:
    """Open the next item unless one is open."""
    if _open_token(db, name, practice):
        return
    now = time.time()
    values = (name, practice, now - ABANDONED_SECONDS)
    item_id = db.execute(NEXT_ITEM, values).fetchone()["item_id"]
    db.execute(
        "INSERT INTO turn (token, annotator, item_id, opened) VALUES (?, ?, ?, ?)",
        (new_token(), name, item_id, now),
    )
