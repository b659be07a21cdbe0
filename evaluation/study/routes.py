"""The study's pages. What somebody sees is always at `/`, and follows from where they stand."""

from __future__ import annotations

import logging
import math
import secrets
import sqlite3
from collections.abc import Callable
from importlib.resources import files
from urllib.parse import parse_qsl

import jinja2
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from data.records import LETTERS
from evaluation.study import auth, workflow
from evaluation.study.guards import Guard

log = logging.getLogger(__name__)

COOKIE = "study"
COOKIE_SECONDS = 90 * 24 * 3600
FORM_BYTES = 4096
LONGEST = 1e7
"""Seconds past which a browser's clock is not believed."""
STATIC = {"study.css": "text/css", "study.js": "text/javascript", "icon.svg": "image/svg+xml"}
REFUSALS = {
    400: "That request could not be understood.",
    401: "You are not signed in here. Open the link that you were given; if it has been used, ask "
    "for a new one.",
    403: "That form has expired.",
    404: "There is nothing here.",
    405: "There is nothing here.",
    410: "This link has been used already, or never was one. Ask for a new one.",
    413: "That request was too long.",
}


class Pages:
    """The endpoints over one study's database."""

    def __init__(
        self,
        db: sqlite3.Connection,
        rest_every: int,
        secure: bool,
        links_changed: Callable[[], None],
    ) -> None:
        """`secure` keeps the session to https; `links_changed` is called when one was spent."""
        self._db = db
        self._rest_every = rest_every
        self._secure = secure
        self._links_changed = links_changed
        loader = jinja2.PackageLoader("evaluation.study")
        self._templates = jinja2.Environment(
            loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
            lstrip_blocks=True,
        )  # fmt: skip
        folder = files("evaluation.study") / "static"
        self._static = {name: (folder / name).read_bytes() for name in STATIC}

    def routes(self) -> list[Route]:
        return [
            Route("/", self.home),
            Route("/link/{link}", self.link),
            Route("/link", self.sign_in, methods=["POST"]),
            Route("/consent", self.consent, methods=["POST"]),
            Route("/go-on", self.go_on, methods=["POST"]),
            Route("/loaded", self.loaded, methods=["POST"]),
            Route("/answer", self.answer, methods=["POST"]),
            Route("/media/{name}", self.media),
            Route("/static/{name}", self.static),
        ]

    async def home(self, request: Request) -> Response:
        me = self._signed_in(request)
        stage = workflow.stage_of(self._db, me, self._rest_every)
        asks = stage.page in ("practice", "feedback", "item")
        question = workflow.question(self._db, stage.key) if asks else None
        page = "question" if asks else stage.page
        return self._page(page, stage=stage, question=question, form_key=me["form_key"])

    async def link(self, request: Request) -> Response:
        # Looking at a link does not spend it: mail programs look too.
        link = request.path_params["link"]
        if auth.owner(self._db, link) is None:
            raise HTTPException(410)
        return self._page("link", link=link)

    async def sign_in(self, request: Request) -> Response:
        link = (await form_of(request)).get("link", "")
        name = auth.owner(self._db, link)
        session = auth.sign_in(self._db, link)
        if session is None:
            raise HTTPException(410)
        log.info("%s signed in", name)
        try:
            self._links_changed()
        except OSError as error:
            # The link is spent: without the session its owner would be locked out.
            log.warning("the file of links still holds that of %s: %s", name, error)
        response = RedirectResponse("/", 303)
        response.set_cookie(
            COOKIE, session, max_age=COOKIE_SECONDS, httponly=True, samesite="lax",
            secure=self._secure,
        )  # fmt: skip
        return response

    async def consent(self, request: Request) -> Response:
        me, _ = await self._posted(request)
        workflow.consent(self._db, me)
        return RedirectResponse("/", 303)

    async def go_on(self, request: Request) -> Response:
        me, form = await self._posted(request)
        workflow.go_on(self._db, me, form.get("key", ""), self._rest_every)
        return RedirectResponse("/", 303)

    async def loaded(self, request: Request) -> Response:
        me, form = await self._posted(request)
        there = workflow.note_loaded(self._db, me["name"], form.get("key", ""))
        return Response(status_code=204 if there else 409)

    async def answer(self, request: Request) -> Response:
        me, form = await self._posted(request)
        letter, seconds = form.get("choice", ""), _seconds(form.get("seconds", ""))
        if letter not in tuple(LETTERS) or seconds is None:
            raise HTTPException(400)
        if workflow.answer(self._db, me["name"], form.get("key", ""), letter, seconds):
            self._tell_end(me)
        return RedirectResponse("/", 303)

    async def media(self, request: Request) -> Response:
        me = self._signed_in(request)
        found = workflow.medium(self._db, me["name"], request.path_params["name"])
        if found is None:
            raise HTTPException(404)
        return Response(found["content"], media_type=found["kind"])

    async def static(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in STATIC:
            raise HTTPException(404)
        return Response(self._static[name], media_type=STATIC[name])

    async def refusal(self, request: Request, error: Exception) -> Response:
        """A page for every refused request. It tells nothing of what was asked for."""
        status = error.status_code if isinstance(error, HTTPException) else 500
        told = REFUSALS.get(status, "Something went wrong here. Try again in a moment.")
        return self._page("refusal", status, refused=status, told=told)

    def _tell_end(self, me: sqlite3.Row) -> None:
        stage = workflow.stage_of(self._db, me, self._rest_every)
        if stage.page == "done":
            log.info("%s has answered all %d items", me["name"], stage.total)

    def _signed_in(self, request: Request) -> sqlite3.Row:
        """Raises HTTPException 401 for somebody without a session."""
        me = auth.signed_in(self._db, request.cookies.get(COOKIE, ""))
        if me is None:
            raise HTTPException(401)
        return me

    async def _posted(self, request: Request) -> tuple[sqlite3.Row, dict[str, str]]:
        """Who sends a form that a page of theirs held, and its fields.

        Raises:
            HTTPException: 401 without a session, 403 for a form of another session's page.
        """
        me = self._signed_in(request)
        form = await form_of(request)
        given = form.get("form_key", "").encode()
        if not secrets.compare_digest(given, me["form_key"].encode()):
            raise HTTPException(403)
        return me, form

    def _page(self, template: str, status: int = 200, **told: object) -> HTMLResponse:
        return HTMLResponse(self._templates.get_template(f"{template}.html").render(told), status)


def make_app(
    db: sqlite3.Connection,
    rest_every: int,
    public: str | None,
    links_changed: Callable[[], None],
) -> ASGIApp:
    """The study as an ASGI application; `public` is its address behind a proxy, if it has one."""
    secure = (public or "").startswith("https:")
    pages = Pages(db, rest_every, secure, links_changed)
    app = Starlette(
        routes=pages.routes(),
        exception_handlers={HTTPException: pages.refusal, 500: pages.refusal},
        max_body_size=FORM_BYTES,
    )
    # Around all of it: what Starlette itself replies to a long body or an error goes through too.
    return Guard(app, public)


async def form_of(request: Request) -> dict[str, str]:
    """The fields of a form. Raises HTTPException 400 for a body that is none."""
    try:
        body = (await request.body()).decode("ascii")
        return dict(parse_qsl(body, keep_blank_values=True, max_num_fields=16))
    except ValueError as error:
        raise HTTPException(400) from error


def _seconds(text: str) -> float | None:
    """A plausible time; None for what is no number, or no such time."""
    try:
        seconds = float(text)
    except ValueError:
        return None
    return seconds if math.isfinite(seconds) and 0 <= seconds < LONGEST else None
