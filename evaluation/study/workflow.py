"""An annotator's way through a study: consent, practice, items with breaks between them, the end.

Where somebody stands follows from the database alone, so that closing the page or ending the server
loses nothing; a step that is not the one to take now changes nothing.
"""

from __future__ import annotations

import sqlite3
import time
from dataclasses import dataclass

from data.records import LETTERS
from evaluation.study.assignment import Waiting, next_item
from evaluation.study.auth import new_token
from evaluation.study.media import PREFIX
from evaluation.study.storage import transaction

ABANDONED = 3600.0
"""Seconds after which an item that was opened and not answered counts as one that was not."""
ANSWERED = """
    SELECT turn.* FROM turn JOIN item USING (item_id)
    WHERE annotator = ? AND practice = ? AND answered IS NOT NULL
"""


@dataclass(frozen=True)
class Stage:
    """Where an annotator stands. `page` is consent, practice, feedback, ready, item, rest or done;
    `key` names this very step, and `number` of `total` items are behind or on the page."""

    page: str
    key: str = ""
    number: int = 0
    total: int = 0


@dataclass(frozen=True)
class Shown:
    """One thing on a page: the name it is fetched by and its size in px."""

    name: str
    width: int
    height: int


@dataclass(frozen=True)
class Question:
    """What a page asks. `right` and `chosen` are letters, told after practice alone."""

    text: str
    prefix: Shown
    candidates: dict[str, Shown]
    right: str | None
    chosen: str | None


def stage_of(db: sqlite3.Connection, me: sqlite3.Row, rest_every: int) -> Stage:
    """Where an annotator stands; an item that comes next is opened."""
    if me["consented"] is None:
        return Stage("consent")
    with transaction(db):
        if stage := _practice(db, me):
            return stage
        total = _count(db, practice=False)
        done = len(db.execute(ANSWERED, (me["name"], False)).fetchall())
        if me["begun"] is None:
            return Stage("ready", "ready", total=total)
        if done == total:
            return Stage("done", number=done, total=total)
        due, left = divmod(done, rest_every)
        if due > me["rests"] and not left:
            return Stage("rest", f"rest-{due}", done, total)
        return Stage("item", _open(db, me["name"], practice=False), done + 1, total)


def _practice(db: sqlite3.Connection, me: sqlite3.Row) -> Stage | None:
    total = _count(db, practice=True)
    turns = db.execute(ANSWERED, (me["name"], True)).fetchall()
    if unread := [turn for turn in turns if not turn["closed"]]:
        return Stage("feedback", unread[0]["token"], len(turns), total)
    if len(turns) < total:
        return Stage("practice", _open(db, me["name"], practice=True), len(turns) + 1, total)
    return None


def consent(db: sqlite3.Connection, me: sqlite3.Row) -> None:
    with transaction(db):
        db.execute(
            "UPDATE annotator SET consented = ? WHERE name = ? AND consented IS NULL",
            (time.time(), me["name"]),
        )


def go_on(db: sqlite3.Connection, me: sqlite3.Row, key: str, rest_every: int) -> None:
    """Leave the page that `key` names, where the annotator stands on it."""
    stage = stage_of(db, me, rest_every)
    if stage.key != key:
        return
    with transaction(db):
        if stage.page == "feedback":
            db.execute("UPDATE turn SET closed = 1 WHERE token = ?", (key,))
        elif stage.page == "ready":
            db.execute("UPDATE annotator SET begun = ? WHERE name = ?", (time.time(), me["name"]))
        elif stage.page == "rest":
            db.execute(
                "UPDATE annotator SET rests = ? WHERE name = ?",
                (stage.number // rest_every, me["name"]),
            )


def note_loaded(db: sqlite3.Connection, name: str, token: str) -> bool:
    """An open item is all on the annotator's screen: its time begins. Returns whether it is one."""
    with transaction(db):
        changed = db.execute(
            "UPDATE turn SET loaded = ?, loads = loads + 1 "
            "WHERE token = ? AND annotator = ? AND answered IS NULL",
            (time.time(), token, name),
        )
    return changed.rowcount == 1


def answer(
    db: sqlite3.Connection, name: str, token: str, letter: str, client_seconds: float
) -> bool:
    """Keep the answer to an open item that is all on the screen. Returns whether it was one; a
    second answer is none."""
    with transaction(db):
        found = db.execute(
            "SELECT shown, practice FROM turn JOIN plan USING (annotator, item_id) "
            "JOIN item USING (item_id) "
            "WHERE token = ? AND annotator = ? AND answered IS NULL AND loaded IS NOT NULL",
            (token, name),
        ).fetchone()
        if found is None:
            return False
        choice = int(found["shown"][LETTERS.index(letter)])
        db.execute(
            "UPDATE turn SET letter = ?, choice = ?, client_seconds = ?, answered = ?, closed = ? "
            "WHERE token = ?",
            (letter, choice, client_seconds, time.time(), not found["practice"], token),
        )
    return True


def question(db: sqlite3.Connection, token: str) -> Question:
    """What the page of an item shows, of practice with its answer once it is given."""
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
    shown = {row["slot"]: Shown(row["token"], row["width"], row["height"]) for row in rows}
    order = [int(slot) for slot in turn["shown"]]
    told = turn["practice"] and turn["answered"] is not None
    return Question(
        turn["question"],
        shown[PREFIX],
        {letter: shown[slot] for letter, slot in zip(LETTERS, order, strict=True)},
        LETTERS[order.index(turn["answer"])] if told else None,
        turn["letter"] if told else None,
    )


def medium(db: sqlite3.Connection, name: str, token: str) -> sqlite3.Row | None:
    """The kind and content of something on the page that an annotator has before them now."""
    return db.execute(
        "SELECT kind, content FROM name JOIN turn ON turn.token = name.turn "
        "JOIN medium USING (item_id, slot) "
        "WHERE name.token = ? AND annotator = ? AND NOT closed",
        (token, name),
    ).fetchone()


def _open(db: sqlite3.Connection, name: str, practice: bool) -> str:
    """The token of the item that is open, or of the next one, opened now."""
    is_open = (
        "SELECT token FROM turn JOIN item USING (item_id) "
        "WHERE annotator = ? AND practice = ? AND answered IS NULL"
    )
    if found := db.execute(is_open, (name, practice)).fetchone():
        return found["token"]
    waiting = _waiting(db, name, practice)
    families = [
        tuple(row)
        for row in db.execute(
            "SELECT family, count(*), count(turn.token) FROM item LEFT JOIN turn "
            "ON turn.item_id = item.item_id AND annotator = ? WHERE practice = ? GROUP BY family",
            (name, practice),
        )
    ]
    item_id = next_item(
        waiting, {f: asked for f, _, asked in families}, {f: total for f, total, _ in families}
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


def _waiting(db: sqlite3.Connection, name: str, practice: bool) -> list[Waiting]:
    rows = db.execute(
        "SELECT item_id, family, scene_id, prefix_stop, rank, "
        "(SELECT count(*) FROM turn WHERE turn.item_id = item.item_id "
        "AND (answered IS NOT NULL OR opened > ?)) AS votes "
        "FROM plan JOIN item USING (item_id) WHERE annotator = ? AND practice = ? "
        "AND item_id NOT IN (SELECT item_id FROM turn WHERE annotator = ?)",
        (time.time() - ABANDONED, name, practice, name),
    )
    return [Waiting(**dict(row)) for row in rows]


def _count(db: sqlite3.Connection, practice: bool) -> int:
    counted = db.execute("SELECT count(*) FROM item WHERE practice = ?", (practice,))
    return counted.fetchone()[0]
