"""The study's pages and server. `/` always shows the page of the annotator's current stage."""

from __future__ import annotations

import logging
import math
import socket
import sqlite3
from collections.abc import Callable
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
from dynapix.evaluation.study import auth, workflow

log = logging.getLogger(__name__)

COOKIE = "study"
MAX_FORM_BYTES = 4096
MAX_SECONDS = 1e7
"""Upper limit of the decision times that browsers may report."""
BACKLOG = 2048
"""Maximum number of connections that wait to be accepted."""
REFUSALS = {
    401: "You are not signed in on this device, or your session has ended. Open your link; if it "
    "has been used, ask for a new one.",
    404: "This page does not exist.",
    410: "This link has been used or is not valid. Ask for a new one.",
    500: "The server failed. Try again in a moment.",
}
"""Explanations of the errors that annotators may see. The study's pages cause no other errors."""


class Pages:
    """The pages of one study. `on_links_changed` is called after a link was used or deleted."""

    def __init__(
        self, db: sqlite3.Connection, cfg: StudyCommand, on_links_changed: Callable[[], object]
    ) -> None:
        self._db = db
        self._rest_every = cfg.rest_every
        self._secure = (cfg.public or "").startswith("https:")
        self._session_seconds = math.ceil(cfg.session_days * 24 * 3600)
        self._on_links_changed = on_links_changed
        self._templates = jinja2.Environment(
            loader=jinja2.PackageLoader("dynapix.evaluation.study"), autoescape=True,
            undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        )  # fmt: skip

    def routes(self) -> list[Route | Mount]:
        return [
            Route("/", self.home),
            Route("/link/{link}", self.link),
            Route("/link", self.sign_in, methods=["POST"]),
            Route("/continue", self.leave_page, methods=["POST"]),
            Route("/loaded", self.loaded, methods=["POST"]),
            Route("/answer", self.answer, methods=["POST"]),
            Route("/withdraw", self.confirm_withdrawal),
            Route("/withdraw", self.withdraw, methods=["POST"]),
            Route("/media/{key}/{place}", self.media),
            Mount("/static", StaticFiles(packages=[("dynapix.evaluation.study", "static")])),
        ]

    async def home(self, request: Request) -> Response:
        annotator = self._annotator(request)
        stage = workflow.current_stage(self._db, annotator, self._rest_every)
        has_question = stage.page in ("practice", "feedback", "item")
        question = workflow.load_question(self._db, stage.key) if has_question else None
        page = "question" if has_question else stage.page
        return self._render(page, stage=stage, question=question)

    async def link(self, request: Request) -> Response:
        # The link is used only when this page's form is sent: mail programs also open links.
        link = request.path_params["link"]
        if not auth.is_unused(self._db, link):
            raise HTTPException(410)
        return self._render("link", link=link)

    async def sign_in(self, request: Request) -> Response:
        signed_in = auth.sign_in(self._db, (await read_form(request)).get("link", ""))
        if signed_in is None:
            raise HTTPException(410)
        name, session = signed_in
        log.info("%s signed in", name)
        self._write_links(name)
        response = RedirectResponse("/", 303)
        response.set_cookie(
            COOKIE, session, max_age=self._session_seconds, httponly=True, samesite="lax",
            secure=self._secure,
        )  # fmt: skip
        return response

    async def leave_page(self, request: Request) -> Response:
        annotator, form = self._annotator(request), await read_form(request)
        workflow.leave_page(self._db, annotator, form.get("key", ""), self._rest_every)
        workflow.open_next_item(self._db, annotator["name"], self._rest_every)
        return RedirectResponse("/", 303)

    async def loaded(self, request: Request) -> Response:
        annotator, form = self._annotator(request), await read_form(request)
        is_open = workflow.record_loaded(self._db, annotator["name"], form.get("key", ""))
        return Response(status_code=204 if is_open else 409)

    async def answer(self, request: Request) -> Response:
        annotator, form = self._annotator(request), await read_form(request)
        letter, seconds = form.get("choice", ""), _parse_seconds(form.get("seconds", ""))
        if letter not in tuple(LETTERS) or seconds is None:
            raise HTTPException(400)
        name, key = annotator["name"], form.get("key", "")
        if workflow.record_answer(self._db, name, key, letter, seconds):
            workflow.open_next_item(self._db, name, self._rest_every)
            stage = workflow.current_stage(self._db, annotator, self._rest_every)
            if stage.page == "done":
                log.info("%s has answered all %d items", name, stage.total)
        return RedirectResponse("/", 303)

    async def confirm_withdrawal(self, request: Request) -> Response:
        self._annotator(request)
        return self._render("withdraw")

    async def withdraw(self, request: Request) -> Response:
        annotator = self._annotator(request)
        await read_form(request)
        workflow.withdraw(self._db, annotator["name"])
        log.info("%s has withdrawn; the answers are deleted", annotator["name"])
        self._write_links(annotator["name"])
        response = self._render("withdrawn")
        response.delete_cookie(COOKIE)
        return response

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
        reason = REFUSALS.get(status, f"{HTTPStatus(status).phrase}.")
        return self._render("refusal", status, status=status, reason=reason)

    def _annotator(self, request: Request) -> sqlite3.Row:
        """Return the annotator of the request's session. Raises HTTPException 401 if none."""
        session = request.cookies.get(COOKIE, "")
        annotator = auth.find_annotator(self._db, session, self._session_seconds)
        if annotator is None:
            raise HTTPException(401)
        return annotator

    def _write_links(self, name: str) -> None:
        try:
            self._on_links_changed()
        except OSError as error:
            # The change is stored: if this request failed, the annotator could not sign in again.
            log.warning("the file of links still has an invalid link of %s: %s", name, error)

    def _render(self, template: str, status_code: int = 200, **values: object) -> HTMLResponse:
        page = self._templates.get_template(f"{template}.html").render(values)
        return HTMLResponse(page, status_code)


def build_app(
    db: sqlite3.Connection, cfg: StudyCommand, on_links_changed: Callable[[], object]
) -> Starlette:
    """Return the study as an ASGI application."""
    pages = Pages(db, cfg, on_links_changed)
    return Starlette(
        routes=pages.routes(),
        exception_handlers={HTTPException: pages.refuse, 500: pages.refuse},
        max_body_size=MAX_FORM_BYTES,
    )


async def read_form(request: Request) -> dict[str, str]:
    """Return the fields of a form.

    Raises:
        HTTPException: 403 for a form of another site, 400 for a body that is not a form.
    """
    if auth.is_cross_site(request.headers):
        raise HTTPException(403)
    try:
        body = (await request.body()).decode("ascii")
        return dict(parse_qsl(body, keep_blank_values=True, max_num_fields=16))
    except ValueError as error:
        raise HTTPException(400) from error


def _parse_seconds(text: str) -> float | None:
    """Return a plausible number of seconds, or None."""
    try:
        seconds = float(text)
    except ValueError:
        return None
    return seconds if 0 <= seconds < MAX_SECONDS else None


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
        timeout_graceful_shutdown=5, headers=list(auth.HEADERS.items()),
    )  # fmt: skip
    uvicorn.Server(settings).run(sockets=[listener])
