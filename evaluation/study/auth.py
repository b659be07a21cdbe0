"""Annotators' accounts: a link that signs in once, and the session it begins."""

from __future__ import annotations

import hashlib
import os
import secrets
import sqlite3
from pathlib import Path

from evaluation.study.storage import transaction

LINKS = "links.txt"


def new_token() -> str:
    return secrets.token_urlsafe(18)


def annotator_names(count: int) -> list[str]:
    return [f"A{k + 1}" for k in range(count)]


def write_links(db: sqlite3.Connection, path: Path, address: str) -> dict[str, str]:
    """Write every annotator's unspent link to a file that its owner alone can read.

    Returns:
        The links by annotator.
    """
    rows = db.execute("SELECT name, link FROM annotator ORDER BY rowid")
    links = {row["name"]: f"{address}/link/{row['link']}" for row in rows}
    lines = [f"{name}  {link}" for name, link in links.items()]
    told = (
        "# A link signs in once. Then a new one stands here, for another device of the same person."
    )
    part = path.with_name(f"{path.name}.tmp")
    handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with open(handle, "w", encoding="utf-8") as file:
        file.write("\n".join([told, *lines]) + "\n")
    os.replace(part, path)
    return links


def owner(db: sqlite3.Connection, link: str) -> str | None:
    """Whose unspent link this is."""
    row = db.execute("SELECT name FROM annotator WHERE link = ?", (link,)).fetchone()
    return row and row["name"]


def sign_in(db: sqlite3.Connection, link: str) -> str | None:
    """Spend a link. The annotator's other session ends.

    Returns:
        The new session's secret; None where the link is spent or never was.
    """
    session = new_token()
    with transaction(db):
        changed = db.execute(
            "UPDATE annotator SET session = ?, form_key = ?, link = ? WHERE link = ?",
            (_hashed(session), new_token(), new_token(), link),
        )
    return session if changed.rowcount else None


def signed_in(db: sqlite3.Connection, session: str) -> sqlite3.Row | None:
    """The annotator whose session this is."""
    asked = "SELECT * FROM annotator WHERE session = ?"
    return db.execute(asked, (_hashed(session),)).fetchone()


def _hashed(session: str) -> str:
    return hashlib.sha256(session.encode()).hexdigest()
