"""Start and kill `python -m evaluation.study`, and take part in a study over HTTP."""

from __future__ import annotations

import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from html import unescape
from http.client import HTTPConnection, HTTPException, HTTPMessage
from pathlib import Path
from urllib.parse import urlencode

from dynapix.evaluation.study import storage
from tests.local import free_port

ROOT = Path(__file__).parents[3]


class Server:
    """Runs the command on the study in a run folder, checkpoints/study/NAME.

    The port stays the same after a restart.
    """

    def __init__(self, folder: Path, *settings: str) -> None:
        self.folder, self.settings = folder, settings
        self.port = free_port()
        self.process: subprocess.Popen[str] | None = None

    def command(self) -> list[str]:
        checkpoints = self.folder.parent.parent
        where = [f"run={self.folder.name}", f"checkpoints={checkpoints}", f"port={self.port}"]
        return [sys.executable, "-m", "evaluation.study", *where, *self.settings]

    def start(self) -> Server:
        output = open(self.folder / "output.txt", "a")  # noqa: SIM115
        self.process = subprocess.Popen(
            self.command(), cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, text=True
        )
        output.close()
        Visitor(self.port).request("GET", "/static/icon.svg")
        return self

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(timeout=60)

    def links(self) -> dict[str, str]:
        """Return the path of each annotator's link, by name."""
        pairs = map(str.split, (self.folder / "links.txt").read_text().splitlines())
        return {name: link.partition(f":{self.port}")[2] for name, link in pairs}


@dataclass(frozen=True)
class Reply:
    """A response of the server."""

    status: int
    headers: HTTPMessage
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    def hidden(self, name: str) -> str:
        """Return the value of a hidden field of the page's form."""
        return unescape(re.search(rf'name="{name}" value="([^"]*)"', self.text)[1])

    def media(self) -> list[str]:
        """Return the paths of the prefix and of the candidates, in the order of the page."""
        return re.findall(r'data-src="([^"]+)"', self.text)

    @property
    def action(self) -> str | None:
        """The path to which the page's form is sent; None if the page has no form."""
        found = re.search(r'action="([^"]+)"', self.text)
        return found and found[1]


class Visitor:
    """An HTTP client with a cookie, which repeats a request until the server responds."""

    def __init__(self, port: int, patience: float = 60) -> None:
        self.port, self.patience = port, patience
        self.cookie: str | None = None
        self._connection: HTTPConnection | None = None

    def request(self, method: str, path: str, fields: dict | None = None, **headers: str) -> Reply:
        if self.cookie:
            headers.setdefault("Cookie", self.cookie)
        body = None
        if fields is not None:
            body = urlencode(fields)
            headers["Content-Type"] = "application/x-www-form-urlencoded"
        until = time.monotonic() + self.patience
        while True:
            try:
                if self._connection is None:
                    self._connection = HTTPConnection("127.0.0.1", self.port, timeout=60)
                self._connection.request(method, path, body, headers)
                response = self._connection.getresponse()
                reply = Reply(response.status, response.msg, response.read())
                break
            except (OSError, HTTPException):
                self._connection = None
                if time.monotonic() > until:
                    raise
                time.sleep(0.05)
        if cookie := reply.headers.get("Set-Cookie"):
            self.cookie = cookie.partition(";")[0]
        return reply

    def home(self) -> Reply:
        return self.request("GET", "/")

    def sign_in(self, link: str) -> Visitor:
        assert self.request("GET", link).status == 303
        return self

    def load(self, page: Reply) -> Reply:
        return self.request("POST", "/loaded", key_of(page))

    def answer(self, page: Reply, letter: str) -> Reply:
        return self.request("POST", "/answer", key_of(page) | {"choice": letter})

    def to_question(self) -> Reply:
        """Agree to take part, and return the page of the open item."""
        self.request("POST", "/consent", {})
        return self.home()


def key_of(page: Reply) -> dict[str, str]:
    return {"key": page.hidden("key")}


@dataclass
class Annotator:
    """Takes part in a study, and remembers the answers: the letters by the key of the item."""

    visitor: Visitor
    choose: Callable[[int], str]
    answers: dict[str, str] = field(default_factory=dict)

    def take_part(self) -> None:
        """Answer all items."""
        page = self.visitor.to_question()
        while page.action == "/answer":
            for path in page.media():
                assert self.visitor.request("GET", path).status in (200, 404)
            self.visitor.load(page)
            letter = self.choose(len(self.answers))
            assert self.visitor.answer(page, letter).status == 303
            self.answers[page.hidden("key")] = letter
            page = self.visitor.home()


def rows(server, query: str, *values) -> list[sqlite3.Row]:
    """Return the rows of a query to the study's database."""
    db = storage.open_study(server.folder / storage.DATABASE)
    try:
        return db.execute(query, values).fetchall()
    finally:
        db.close()
