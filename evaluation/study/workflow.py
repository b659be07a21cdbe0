"""The stages of an annotator: consent, the items one after the other, and the end.

The database alone determines the stage, so that nothing is lost if a page is closed or the server
stops. A request that does not belong to the current stage changes nothing.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass
from typing import Any

from dynapix.data.records import LETTERS
from dynapix.evaluation.study.media import PREFIX
from dynapix.evaluation.study.storage import new_token, transaction

TURN = "SELECT * FROM turn JOIN plan USING (annotator, item_id) JOIN item USING (item_id)"
NEXT_ITEM = """
WITH
    own AS (
        SELECT item.*, rank, token FROM plan JOIN item USING (item_id)
        LEFT JOIN turn USING (annotator, item_id) WHERE annotator = ?
    ),
    progress AS (SELECT family, 1.0 * count(token) / count(*) AS share FROM own GROUP BY family),
    vote AS (SELECT item_id, count(*) AS votes FROM turn GROUP BY item_id)
SELECT item_id FROM own JOIN progress USING (family) LEFT JOIN vote USING (item_id)
WHERE token IS NULL ORDER BY share, coalesce(votes, 0), rank LIMIT 1
"""
"""Selects the item that is opened next for an annotator.

It is of the family of which the annotator has seen the smallest share, so that even the answers of
an annotator who stops early cover the families in proportion. Within a family, the items with the
fewest votes come first.
"""


@dataclass(frozen=True)
class Stage:
    """An annotator's current stage.

    Attributes:
        page: consent, question or done.
        key: The random token of the open item.
        answered: Number of the annotator's answered items.
        total: Number of all items.
    """

    page: str
    key: str
    answered: int
    total: int


def current_stage(db: sqlite3.Connection, annotator: sqlite3.Row) -> Stage:
    """Return an annotator's stage, and open the next item if the previous one is answered."""
    query = """
        SELECT count(*), (SELECT count(*) FROM turn WHERE annotator = ? AND answered) FROM item
    """
    name = annotator["name"]
    total, answered = db.execute(query, (name,)).fetchone()
    if annotator["consented"] is None:
        return Stage("consent", "", answered, total)
    if answered == total:
        return Stage("done", "", answered, total)
    query = f"{TURN} WHERE annotator = ? AND answered IS NULL"
    turn = db.execute(query, (name,)).fetchone()
    key = turn["token"] if turn else open_next_item(db, name)
    return Stage("question", key, answered, total)


def open_next_item(db: sqlite3.Connection, name: str) -> str:
    """Open the next item of an annotator, and return its token."""
    token = new_token()
    with transaction(db):
        item_id = db.execute(NEXT_ITEM, (name,)).fetchone()["item_id"]
        db.execute(
            "INSERT INTO turn (token, annotator, item_id, opened) VALUES (?, ?, ?, ?)",
            (token, name, item_id, time.time()),
        )
    return token


def consent(db: sqlite3.Connection, name: str) -> None:
    with transaction(db):
        query = "UPDATE annotator SET consented = ? WHERE name = ?"
        db.execute(query, (time.time(), name))


def withdraw(db: sqlite3.Connection, name: str) -> None:
    """Delete an annotator with all answers."""
    with transaction(db):
        for table, column in (("turn", "annotator"), ("plan", "annotator"), ("annotator", "name")):
            db.execute(f"DELETE FROM {table} WHERE {column} = ?", (name,))


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


def record_answer(db: sqlite3.Connection, name: str, token: str, letter: str) -> None:
    """Store the answer to an item, if the item is open and loaded."""
    with transaction(db):
        turn = db.execute(
            f"{TURN} WHERE token = ? AND annotator = ? AND answered IS NULL AND loaded IS NOT NULL",
            (token, name),
        ).fetchone()
        if turn is not None:
            choice = int(turn["shown"][LETTERS.index(letter)])
            db.execute(
                "UPDATE turn SET letter = ?, choice = ?, answered = ? WHERE token = ?",
                (letter, choice, time.time(), token),
            )


def load_question(db: sqlite3.Connection, token: str) -> dict[str, Any]:
    """Return the `text` of an item's question, and the `width` and `height` of its media (px)."""
    turn = db.execute(f"{TURN} WHERE token = ?", (token,)).fetchone()
    query = "SELECT width, height FROM medium WHERE item_id = ? AND slot = ?"
    size = db.execute(query, (turn["item_id"], PREFIX)).fetchone()
    return {"text": turn["question"], **dict(size)}


def load_medium(db: sqlite3.Connection, name: str, token: str, place: str) -> sqlite3.Row | None:
    """Return the kind and content of a medium of the annotator's open item; None if there is no
    such medium. `place` is "prefix" or the letter of a candidate."""
    query = f"{TURN} WHERE token = ? AND annotator = ? AND answered IS NULL"
    turn = db.execute(query, (token, name)).fetchone()
    if turn is None or place not in ("prefix", *LETTERS):
        return None
    slot = PREFIX if place == "prefix" else int(turn["shown"][LETTERS.index(place)])
    query = "SELECT kind, content FROM medium WHERE item_id = ? AND slot = ?"
    return db.execute(query, (turn["item_id"], slot)).fetchone()
