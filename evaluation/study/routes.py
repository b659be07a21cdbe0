"""The study's pages and server. `/` always shows the page of the annotator's current stage."""

from __future__ import annotations

import logging
import socket
import sqlite3
from http import HTTPStatus
from urllib.parse import parse_qsl

import jinja2
import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from dynapix.conf.errors import UserError
from dynapix.conf.schema import StudyCommand
from dynapix.data.records import LETTERS
from dynapix.evaluation.study import workflow

log = logging.getLogger(__name__)

COOKIE = "study"
COOKIE_SECONDS = 90 * 24 * 3600
MAX_FORM_BYTES = 4096
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
    "Referrer-Policy": "same-origin",
    "X-Robots-Tag": "noindex, nofollow",
    # A browser must not show an answered item again from its cache.
    "Cache-Control": "no-store",
}
"""Headers of every response."""
BACKLOG = 2048
"""Maximum number of connections that wait to be accepted."""
REFUSALS = {
    401: "You are not signed in on this device. Open your personal link.",
    404: "This page does not exist.",
    500: "The server failed. Try again in a moment.",
}
"""Explanations of the errors that annotators may see. The study's pages cause no other errors."""


class Pages:
    """The pages of one study."""

    def __init__(self, db: sqlite3.Connection, cfg: StudyCommand) -> None:
        self._db = db
        self._secure = (cfg.public or "").startswith("https:")
        self._templates = jinja2.Environment(
            loader=jinja2.PackageLoader("dynapix.evaluation.study"), autoescape=True,
            undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        )  # fmt: skip

    def routes(self) -> list[Route | Mount]:
        return [
            Route("/", self.home),
            Route("/link/{secret}", self.sign_in),
            Route("/consent", self.consent, methods=["POST"]),
            Route("/loaded", self.loaded, methods=["POST"]),
            Route("/answer", self.answer, methods=["POST"]),
            Route("/withdraw", self.confirm_withdrawal),
            Route("/withdraw", self.withdraw, methods=["POST"]),
            Route("/media/{key}/{place}", self.media),
            Mount("/static", StaticFiles(packages=[("dynapix.evaluation.study", "static")])),
        ]

    async def home(self, request: Request) -> Response:
        stage = workflow.current_stage(self._db, self._annotator(request))
        question = workflow.load_question(self._db, stage.key) if stage.key else None
        return self._render(stage.page, stage=stage, question=question)

    async def sign_in(self, request: Request) -> Response:
        secret = request.path_params["secret"]
        self._find_annotator(secret)
        response = RedirectResponse("/", 303)
        # Browsers send a lax cookie with no form of another site.
        response.set_cookie(
            COOKIE, secret, max_age=COOKIE_SECONDS, httponly=True, samesite="lax",
            secure=self._secure,
        )  # fmt: skip
        return response

    async def consent(self, request: Request) -> Response:
        workflow.consent(self._db, self._annotator(request)["name"])
        return RedirectResponse("/", 303)

    async def loaded(self, request: Request) -> Response:
        annotator, form = self._annotator(request), await read_form(request)
        is_open = workflow.record_loaded(self._db, annotator["name"], form.get("key", ""))
        return Response(status_code=204 if is_open else 409)

    async def answer(self, request: Request) -> Response:
        annotator, form = self._annotator(request), await read_form(request)
        if (letter := form.get("choice")) not in tuple(LETTERS):
            raise HTTPException(400)
        workflow.record_answer(self._db, annotator["name"], form.get("key", ""), letter)
        return RedirectResponse("/", 303)

    async def confirm_withdrawal(self, request: Request) -> Response:
        self._annotator(request)
        return self._render("withdraw")

    async def withdraw(self, request: Request) -> Response:
        name = self._annotator(request)["name"]
        workflow.withdraw(self._db, name)
        log.info("%s has withdrawn; the answers are deleted", name)
        text = "You have withdrawn from the study. You can close this page."
        return self._render("message", title="Your answers are deleted", text=text)

    async def media(self, request: Request) -> Response:
        annotator = self._annotator(request)
        key, place = request.path_params["key"], request.path_params["place"]
        medium = workflow.load_medium(self._db, annotator["name"], key, place)
        if medium is None:
            raise HTTPException(404)
        return Response(medium["content"], media_type=medium["kind"])

    async def refuse(self, request: Request, error: Exception) -> Response:
        """Render the page of a refused request. It repeats no part of the request."""
        status = error.status_code if isinstance(error, HTTPException) else 500
        text = REFUSALS.get(status, f"{HTTPStatus(status).phrase}.")
        return self._render("message", status, title="That did not work", text=text)

    def _annotator(self, request: Request) -> sqlite3.Row:
        """Return the annotator of the request's cookie. Raises HTTPException 401 if none."""
        return self._find_annotator(request.cookies.get(COOKIE, ""))

    def _find_annotator(self, secret: str) -> sqlite3.Row:
        query = "SELECT * FROM annotator WHERE secret = ?"
        annotator = self._db.execute(query, (secret,)).fetchone()
        if annotator is None:
            raise HTTPException(401)
        return annotator

    def _render(self, template: str, status_code: int = 200, **values: object) -> HTMLResponse:
        page = self._templates.get_template(f"{template}.html").render(values)
        return HTMLResponse(page, status_code)


def build_app(db: sqlite3.Connection, cfg: StudyCommand) -> Starlette:
    """Return the study as an ASGI application."""
    pages = Pages(db, cfg)
    return Starlette(
        routes=pages.routes(),
        exception_handlers={HTTPException: pages.refuse, 500: pages.refuse},
        max_body_size=MAX_FORM_BYTES,
    )


async def read_form(request: Request) -> dict[str, str]:
    """Return the fields of a form. Raises HTTPException 400 for a body that is not a form."""
    try:
        body = (await request.body()).decode("ascii")
        return dict(parse_qsl(body, keep_blank_values=True, max_num_fields=16))
    except ValueError as error:
        raise HTTPException(400) from error


def listen(host: str, port: int) -> socket.socket:
    """Open a listening socket. Raises UserError if the address cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise UserError(
            f"cannot serve the study at host={host} and port={port} ({error.strerror}): choose a "
            "free port above 1023, and an address of this machine",
            code="invalid-address",
        ) from error


def serve(app: Starlette, listener: socket.socket) -> None:
    """Serve until Ctrl-C or SIGTERM."""
    # Uvicorn's own log would record the requests of each annotator.
    settings = uvicorn.Config(
        app, log_config=None, log_level="warning", access_log=False, server_header=False,
        proxy_headers=False, lifespan="off", ws="none", backlog=BACKLOG,
        timeout_graceful_shutdown=5, headers=list(HEADERS.items()),
    )  # fmt: skip
    uvicorn.Server(settings).run(sockets=[listener])
