"""Sign-in links, sessions, and protection against other sites."""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
from pathlib import Path

from starlette.datastructures import Headers

from evaluation.study.storage import transaction

LINKS_FILE = "links.txt"
POLICY = (
    "default-src 'none'",
    "script-src 'self'",
    "style-src 'self'",
    # The script fetches a page's media and shows them from memory.
    "img-src 'self' blob:",
    "media-src blob:",
    "connect-src 'self'",
    "form-action 'self'",
    "frame-ancestors 'none'",
    "base-uri 'none'",
)
HEADERS = {
    "Content-Security-Policy": "; ".join(POLICY),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    # With no-referrer, browsers would not send a form's origin either.
    "Referrer-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "X-Robots-Tag": "noindex, nofollow",
    # An answered item must not be shown again from a cache.
    "Cache-Control": "no-store",
}
"""Headers of every response."""


def new_token() -> str:
    return secrets.token_urlsafe(18)


def write_links(db: sqlite3.Connection, path: Path, address: str) -> dict[str, str]:
    """Write every annotator's unused link to a file that only its owner can read; return the links
    by annotator."""
    rows = db.execute("SELECT name, link FROM annotator ORDER BY rowid")
    links = {row["name"]: f"{address}/link/{row['link']}" for row in rows}
    note = "# A link signs in once; a new one then replaces it, for another device of that person."
    path.touch(mode=0o600)
    path.chmod(0o600)
    path.write_text("\n".join([note, *(f"{name}  {link}" for name, link in links.items()), ""]))
    return links


def is_unused(db: sqlite3.Connection, link: str) -> bool:
    return db.execute("SELECT 1 FROM annotator WHERE link = ?", (link,)).fetchone() is not None


def sign_in(db: sqlite3.Connection, link: str) -> tuple[str, str] | None:
    """Use a link, end the annotator's previous session, and return the annotator and the secret of
    the new session; None if the link is used or unknown."""
    session = new_token()
    with transaction(db):
        row = db.execute(
            "UPDATE annotator SET session = ?, link = ? WHERE link = ? RETURNING name",
            (_hash(session), new_token(), link),
        ).fetchone()
    return row and (row["name"], session)


def find_annotator(db: sqlite3.Connection, session: str) -> sqlite3.Row | None:
    """Return the annotator of a session, or None."""
    query = "SELECT * FROM annotator WHERE session = ?"
    return db.execute(query, (_hash(session),)).fetchone()


def _hash(session: str) -> str:
    return hashlib.sha256(session.encode()).hexdigest()


def is_cross_site(headers: Headers) -> bool:
    """Return whether the browser sent the form from a page of another site."""
    if (site := headers.get("sec-fetch-site")) is not None:
        return site not in ("same-origin", "none")
    # Browsers omit that header on plain http, except on this machine.
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers.get("host")
