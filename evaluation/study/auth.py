"""Sign-in links, sessions, and protection against requests from other sites."""

from __future__ import annotations

import hashlib
import secrets
import sqlite3
import time
from pathlib import Path

from starlette.datastructures import Headers

from dynapix.evaluation.study.storage import transaction

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
    # With no-referrer, browsers would send "null" as the origin of a form.
    "Referrer-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "X-Robots-Tag": "noindex, nofollow",
    # A browser must not show an answered item again from its cache.
    "Cache-Control": "no-store",
}
"""Headers of every response."""


def new_token() -> str:
    return secrets.token_urlsafe(18)


def write_links(db: sqlite3.Connection, path: Path, address: str) -> dict[str, str]:
    """Write the unused link of each annotator to a file that only its owner can read. Return the
    links by annotator."""
    rows = db.execute("SELECT name, link FROM annotator ORDER BY rowid")
    links = {row["name"]: f"{address}/link/{row['link']}" for row in rows}
    note = "# A link signs in once. Then a new link replaces it, for signing in on another device."
    path.touch(mode=0o600)
    path.chmod(0o600)
    path.write_text("\n".join([note, *(f"{name}  {link}" for name, link in links.items()), ""]))
    return links


def is_unused(db: sqlite3.Connection, token: str) -> bool:
    return db.execute("SELECT 1 FROM annotator WHERE link = ?", (token,)).fetchone() is not None


def sign_in(db: sqlite3.Connection, token: str) -> tuple[str, str] | None:
    """Start a session with the token of a link, and end the annotator's previous session. Return
    the annotator and the secret of the session; None if the link was used or is unknown."""
    session = new_token()
    with transaction(db):
        row = db.execute(
            "UPDATE annotator SET session = ?, signed_in = ?, link = ? WHERE link = ? "
            "RETURNING name",
            (_hash(session), time.time(), new_token(), token),
        ).fetchone()
    return row and (row["name"], session)


def find_annotator(db: sqlite3.Connection, session: str, max_seconds: float) -> sqlite3.Row | None:
    """Return the annotator of a session that began at most `max_seconds` ago, or None."""
    query = "SELECT * FROM annotator WHERE session = ? AND signed_in > ?"
    return db.execute(query, (_hash(session), time.time() - max_seconds)).fetchone()


def _hash(session: str) -> str:
    return hashlib.sha256(session.encode()).hexdigest()


def is_cross_site(headers: Headers) -> bool:
    """Return whether a browser sent the form from a page of another site."""
    if (site := headers.get("sec-fetch-site")) is not None:
        return site not in ("same-origin", "none")
    # Without https, browsers send that header only to this machine.
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers.get("host")
