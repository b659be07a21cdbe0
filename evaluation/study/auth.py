"""Who may do what: sign-in links, sessions, and the refusal of other sites' forms."""

from __future__ import annotations

import hashlib
import os
import secrets
import sqlite3
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from evaluation.study.storage import transaction

LINKS_FILE = "links.txt"
POLICY = "; ".join(
    [
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
    ]
)
HEADERS = {
    "Content-Security-Policy": POLICY,
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
DEFAULT_PORTS = {"http": 80, "https": 443}


def new_token() -> str:
    return secrets.token_urlsafe(18)


def write_links(db: sqlite3.Connection, path: Path, address: str) -> dict[str, str]:
    """Write every annotator's unused link to a file that only its owner can read.

    Returns:
        The links by annotator.
    """
    rows = db.execute("SELECT name, link FROM annotator ORDER BY rowid")
    links = {row["name"]: f"{address}/link/{row['link']}" for row in rows}
    note = "# A link signs in once; a new one then replaces it, for another device of that person."
    lines = [note, *(f"{name}  {link}" for name, link in links.items())]
    part = path.with_name(f"{path.name}.tmp")
    handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with open(handle, "w", encoding="utf-8") as file:
        file.write("\n".join(lines) + "\n")
    os.replace(part, path)
    return links


def find_link_owner(db: sqlite3.Connection, link: str) -> str | None:
    """The annotator of an unused link."""
    row = db.execute("SELECT name FROM annotator WHERE link = ?", (link,)).fetchone()
    return row and row["name"]


def sign_in(db: sqlite3.Connection, link: str) -> str | None:
    """Use a link. The annotator's previous session ends.

    Returns:
        The secret of the new session; None if the link is used or unknown.
    """
    session = new_token()
    with transaction(db):
        changed = db.execute(
            "UPDATE annotator SET session = ?, form_key = ?, link = ? WHERE link = ?",
            (_hash(session), new_token(), new_token(), link),
        )
    return session if changed.rowcount else None


def find_annotator(db: sqlite3.Connection, session: str) -> sqlite3.Row | None:
    """The annotator of a session."""
    query = "SELECT * FROM annotator WHERE session = ?"
    return db.execute(query, (_hash(session),)).fetchone()


def _hash(session: str) -> str:
    return hashlib.sha256(session.encode()).hexdigest()


class SiteGuard:
    """Middleware: adds `HEADERS` to every response and refuses forms from other sites.

    Args:
        public: The study's address behind a proxy, if there is one.
    """

    def __init__(self, app: ASGIApp, public: str | None) -> None:
        self._app = app
        self._public = _host_and_port(public) if public else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        if scope["type"] != "http":
            return
        if scope["method"] == "POST" and self._is_cross_site(Headers(scope=scope)):
            refusal = PlainTextResponse("This form comes from another site.", 403)
            await refusal(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)

    def _is_cross_site(self, headers: Headers) -> bool:
        """Whether a browser names another site as the form's origin; other clients name none."""
        origin = headers.get("origin")
        if origin is None:
            return headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none")
        own = f"{origin.partition(':')[0]}://{headers.get('host', '')}"
        return _host_and_port(origin) not in {_host_and_port(own), self._public} - {None}


def _host_and_port(url: str) -> tuple[str, int | None] | None:
    """The normalized host and port of a URL; None if it has no host."""
    try:
        parts = urlsplit(url)
        port = parts.port or DEFAULT_PORTS.get(parts.scheme)
    except ValueError:
        return None
    return (parts.hostname, port) if parts.hostname else None
