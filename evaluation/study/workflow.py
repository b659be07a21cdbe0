"""The stages of an annotator: consent, practice, items with breaks between them, and the end.

The stage follows from the database alone, so that nothing is lost when a page closes or the server
stops. A step that does not belong to the current stage changes nothing.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass

from data.records import LETTERS
from evaluation.study.assignment import WaitingItem, next_item
from evaluation.study.auth import new_token
from evaluation.study.media import PREFIX
from evaluation.study.storage import transaction

ABANDONED_SECONDS = 3600.0
"""Age of an open, unanswered item after which it does not count as a vote to come."""
ANSWERED = """
    SELECT turn.* FROM turn JOIN item USING (item_id)
    WHERE annotator = ? AND practice = ? AND answered IS NOT NULL
"""


@dataclass(frozen=True)
class Stage:
    """An annotator's current stage.

    Attributes:
        page: consent, practice, feedback, ready, item, rest or done.
        key: Identifies this step in its form.
        number, total: Items answered or on the page, and all of them.
    """

    page: str
    key: str = ""
    number: int = 0
    total: int = 0


@dataclass(frozen=True)
class PageMedium:
    """An image or a video on a page: the name of its URL, and its size in pixels."""

    name: str
    width: int
    height: int


@dataclass(frozen=True)
class Question:
    """An item's page. `correct` and `chosen` are letters, set after practice only."""

    text: str
    prefix: PageMedium
    candidates: dict[str, PageMedium]
    correct: str | None
    chosen: str | None


def current_stage(db: sqlite3.Connection, annotator: sqlite3.Row, rest_every: int) -> Stage:
    """An annotator's stage; the next item is opened if none is open."""
    if annotator["consented"] is None:
        return Stage("consent")
    name = annotator["name"]
    with transaction(db):
        if stage := _practice_stage(db, name):
            return stage
        total = _count_items(db, practice=False)
        done = len(db.execute(ANSWERED, (name, False)).fetchall())
        if annotator["begun"] is None:
            return Stage("ready", "ready", total=total)
        if done == total:
            return Stage("done", number=done, total=total)
        rests, items_since = divmod(done, rest_every)
        if rests > annotator["rests"] and not items_since:
            return Stage("rest", f"rest-{rests}", done, total)
        return Stage("item", _open_item(db, name, practice=False), done + 1, total)


def _practice_stage(db: sqlite3.Connection, name: str) -> Stage | None:
    total = _count_items(db, practice=True)
    turns = db.execute(ANSWERED, (name, True)).fetchall()
    if unread := [turn for turn in turns if not turn["closed"]]:
        return Stage("feedback", unread[0]["token"], len(turns), total)
    if len(turns) < total:
        return Stage("practice", _open_item(db, name, practice=True), len(turns) + 1, total)
    return None


def record_consent(db: sqlite3.Connection, annotator: sqlite3.Row) -> None:
    with transaction(db):
        db.execute(
            "UPDATE annotator SET consented = ? WHERE name = ? AND consented IS NULL",
            (time.time(), annotator["name"]),
        )


def leave_page(db: sqlite3.Connection, annotator: sqlite3.Row, key: str, rest_every: int) -> None:
    """Leave the feedback, the start or the break with this key, if it is the current page."""
    stage = current_stage(db, annotator, rest_every)
    if stage.key != key:
        return
    name = annotator["name"]
    with transaction(db):
        if stage.page == "feedback":
            db.execute("UPDATE turn SET closed = 1 WHERE token = ?", (key,))
        elif stage.page == "ready":
            db.execute("UPDATE annotator SET begun = ? WHERE name = ?", (time.time(), name))
        elif stage.page == "rest":
            rests = stage.number // rest_every
            db.execute("UPDATE annotator SET rests = ? WHERE name = ?", (rests, name))


def record_loaded(db: sqlite3.Connection, name: str, token: str) -> bool:
    """Start the time of an open item, whose page is completely visible. False if none is open."""
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
    """Store the answer to an open, loaded item. False if no such item is open."""
    with transaction(db):
        turn = db.execute(
            "SELECT shown, practice FROM turn JOIN plan USING (annotator, item_id) "
            "JOIN item USING (item_id) "
            "WHERE token = ? AND annotator = ? AND answered IS NULL AND loaded IS NOT NULL",
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


def load_question(db: sqlite3.Connection, token: str) -> Question:
    """The content of an item's page; an answered practice item includes the correct letter."""
    turn = db.execute(
        "SELECT * FROM turn JOIN plan USING (annotator, item_id) JOIN item USING (item_id) "
        "WHERE token = ?",
        (token,),
    ).fetchone()
    rows = db.execute(
        "SELECT name.token AS token, slot, width, height FROM name "
        "JOIN medium USING (slot) WHERE turn = ? AND item_id = ?",
        (token, turn["item_id"]),
    )
    media = {row["slot"]: PageMedium(row["token"], row["width"], row["height"]) for row in rows}
    order = [int(slot) for slot in turn["shown"]]
    has_feedback = turn["practice"] and turn["answered"] is not None
    return Question(
        turn["question"],
        media[PREFIX],
        {letter: media[slot] for letter, slot in zip(LETTERS, order, strict=True)},
        LETTERS[order.index(turn["answer"])] if has_feedback else None,
        turn["letter"] if has_feedback else None,
    )


def load_medium(db: sqlite3.Connection, name: str, token: str) -> sqlite3.Row | None:
    """The kind and content of a medium on the annotator's current page."""
    return db.execute(
        "SELECT kind, content FROM name JOIN turn ON turn.token = name.turn "
        "JOIN medium USING (item_id, slot) "
        "WHERE name.token = ? AND annotator = ? AND NOT closed",
        (token, name),
    ).fetchone()


def _open_item(db: sqlite3.Connection, name: str, practice: bool) -> str:
    """The token of the open item; without one, the next item is opened."""
    open_turn = db.execute(
        "SELECT token FROM turn JOIN item USING (item_id) "
        "WHERE annotator = ? AND practice = ? AND answered IS NULL",
        (name, practice),
    ).fetchone()
    if open_turn:
        return open_turn["token"]
    families = db.execute(
        "SELECT family, count(*) AS total, count(turn.token) AS opened FROM item LEFT JOIN turn "
        "ON turn.item_id = item.item_id AND annotator = ? WHERE practice = ? GROUP BY family",
        (name, practice),
    ).fetchall()
    item_id = next_item(
        _waiting_items(db, name, practice),
        {row["family"]: row["opened"] for row in families},
        {row["family"]: row["total"] for row in families},
    )
    token = new_token()
    db.execute(
        "INSERT INTO turn (token, annotator, item_id, opened) VALUES (?, ?, ?, ?)",
        (token, name, item_id, time.time()),
    )
    slots = db.execute("SELECT slot FROM medium WHERE item_id = ?", (item_id,)).fetchall()
    names = [(new_token(), token, row["slot"]) for row in slots]
    db.executemany("INSERT INTO name VALUES (?, ?, ?)", names)
    return token


def _waiting_items(db: sqlite3.Connection, name: str, practice: bool) -> list[WaitingItem]:
    rows = db.execute(
        "SELECT item_id, family, scene_id, prefix_stop, rank, "
        "(SELECT count(*) FROM turn WHERE turn.item_id = item.item_id "
        "AND (answered IS NOT NULL OR opened > ?)) AS votes "
        "FROM plan JOIN item USING (item_id) WHERE annotator = ? AND practice = ? "
        "AND item_id NOT IN (SELECT item_id FROM turn WHERE annotator = ?)",
        (time.time() - ABANDONED_SECONDS, name, practice, name),
    )
    return [WaitingItem(**dict(row)) for row in rows]


def _count_items(db: sqlite3.Connection, practice: bool) -> int:
    rows = db.execute("SELECT count(*) FROM item WHERE practice = ?", (practice,))
    return rows.fetchone()[0]
