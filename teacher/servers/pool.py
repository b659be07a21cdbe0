"""Asks a set of servers. One that is down, restarting or busy costs time, not attempts."""

from __future__ import annotations

import asyncio
import logging
import math
import random
import time

from conf.errors import UserError
from conf.schema import ServersConfig
from teacher.servers.server import (
    MalformedReplyError,
    Messages,
    RateLimitedError,
    RefusedError,
    RequestError,
    RequestFields,
    Response,
    Server,
)

log = logging.getLogger(__name__)

PAUSE, LONGEST_PAUSE = 0.5, 10.0
"""Seconds of the first pause before something is tried again at most, doubled up to the longest."""
FAULTS = 4
"""Requests for one item that may fail in a row at servers that are up."""
CANARY: Messages = [{"role": "user", "content": "Say hello."}]
"""What any server can answer: it tells whether a server is broken or an item is."""


class NoResponseError(Exception):
    """Servers that answer other requests have no answer to this one."""


class Place:
    """A server in use."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.in_flight = 0
        self.problem: str | None = None
        """Why it is not asked."""
        self.free_at = -math.inf
        """When it may be asked again, in time.monotonic()'s seconds."""
        self.limited = 0
        """Times in a row that it wanted to be left alone."""
        self.looking = asyncio.Lock()
        self.looked_at = -math.inf
        self.watch: asyncio.Task[None] | None = None

    @property
    def ready(self) -> bool:
        return self.problem is None and self.free_at <= time.monotonic()

    def rest(self, limit: RateLimitedError) -> None:
        """Leave it alone for as long as it says."""
        now = time.monotonic()
        # Those that were in flight together are refused together.
        self.limited += self.free_at <= now
        seconds = limit.seconds if limit.seconds is not None else jitter(self.limited)
        self.free_at = max(self.free_at, now + seconds)


class ServerPool:
    """Asks `cfg.model` at `cfg.urls`, each time at the least busy server that is up.

    `request` goes with every chat. `canary` is what any server can answer that serves such chats,
    `kind` what they are asked as. Use it inside one event loop, as a context.
    """

    def __init__(
        self,
        cfg: ServersConfig,
        request: RequestFields,
        canary: Messages = CANARY,
        kind: type[Server] = Server,
    ) -> None:
        self.cfg, self.request, self.canary = cfg, request, canary
        self.places = [Place(kind(url, cfg)) for url in dict.fromkeys(cfg.urls)]
        self.stuck_since: float | None = None
        """When no server could be asked, with no answer since."""

    async def __aenter__(self) -> ServerPool:
        await asyncio.gather(*(self._look(place) for place in self.places))
        return self

    async def __aexit__(self, *_: object) -> None:
        watches = [place.watch for place in self.places if place.watch]
        for watch in watches:
            watch.cancel()
        await asyncio.gather(*watches, return_exceptions=True)
        await asyncio.gather(*(place.server.close() for place in self.places))

    async def complete(self, chat: Messages, n: int = 1, **own: object) -> list[Response]:
        """Up to `n` answers to a chat, however often servers have to be waited for; `own` are
        fields of this request alone.

        Raises:
            UnansweredError: servers that are up fail at this chat again and again, or refuse it.
            UserError: no server can be asked for longer than `cfg.patience`, or one does not know
                the model, refuses any request, or is of another kind.
        """
        faults = 0
        while True:
            place = await self._free_place()
            try:
                return await self._ask(place, chat, n, self.request | own)
            except RateLimitedError as limit:
                place.rest(limit)
                continue
            except RequestError as fault:
                if not await self._look(place):
                    continue
                faults += 1
                if faults == FAULTS or isinstance(fault, RefusedError):
                    if await self._sings(place):
                        raise NoResponseError(str(fault)) from fault
                    faults = 0
            await asyncio.sleep(jitter(faults))

    async def _ask(
        self, place: Place, chat: Messages, n: int, request: RequestFields
    ) -> list[Response]:
        place.in_flight += 1
        try:
            replies = await place.server.complete(chat, n, request)
        finally:
            place.in_flight -= 1
        place.limited, self.stuck_since = 0, None
        return replies

    async def _free_place(self) -> Place:
        """The least busy server that may be asked now. Raises UserError without patience left."""
        while not (ready := [place for place in self.places if place.ready]):
            self.stuck_since = self.stuck_since or time.monotonic()
            if time.monotonic() - self.stuck_since > self.cfg.patience:
                raise self._gone()
            # Those that wait do not come back all at once.
            await asyncio.sleep(random.uniform(0, PAUSE))
        return min(ready, key=lambda place: place.in_flight)

    async def _look(self, place: Place) -> bool:
        """Whether a server is up. One that is not is watched until it is."""
        failed_at = time.monotonic()
        # One look does for every request that failed before it.
        async with place.looking:
            if place.problem is None and place.looked_at < failed_at:
                problem = await place.server.health()
                place.looked_at = time.monotonic()
                if problem is not None:
                    self._set_aside(place, problem)
        return place.problem is None

    def _set_aside(self, place: Place, problem: str, broken: bool = False) -> None:
        log.info(f"{place.server.url} is not up ({problem}): waiting for it")
        place.problem = problem
        place.watch = asyncio.create_task(self._until_up(place, broken))

    async def _until_up(self, place: Place, broken: bool) -> None:
        looks = 0
        while place.problem is not None:
            looks += 1
            await asyncio.sleep(jitter(looks))
            problem = await place.server.health()
            # Broken is a server whose health page does not show it.
            if problem is None and broken:
                try:
                    problem = await self._canary(place)
                except (RequestError, UserError) as error:
                    problem = str(error)
            place.problem = problem
        log.info(f"{place.server.url} is up again")

    async def _sings(self, place: Place) -> bool:
        """Whether a server answers what any server can. Raises UserError for one that refuses it or
        is of another kind."""
        try:
            problem = await self._canary(place)
        except RefusedError as fault:
            raise UserError(f"{place.server.url} refuses any request: {fault}") from fault
        except MalformedReplyError as fault:
            raise UserError(
                f"{place.server.url} does not answer as an OpenAI-compatible server does "
                f"({fault}); such a URL ends in /v1"
            ) from fault
        if problem is not None and place.problem is None:
            self._set_aside(place, problem, broken=True)
        return problem is None

    async def _canary(self, place: Place) -> str | None:
        """What is wrong with a server's answer to any chat, None for an answer."""
        try:
            await self._ask(place, self.canary, 1, self.request | {"max_tokens": 1})
        except (MalformedReplyError, RefusedError):
            raise
        except RequestError as fault:
            return str(fault)
        return None

    def _gone(self) -> UserError:
        problems = "; ".join(
            f"{place.server.url}: {place.problem or 'it wants to be left alone (HTTP 429)'}"
            for place in self.places
        )
        return UserError(
            f"no server of {self.cfg.GROUP}.url could be asked for {self.cfg.GROUP}.patience="
            f"{self.cfg.patience:g} seconds ({problems}); start one and run this again, it goes on "
            "with what is answered"
        )


def jitter(times: int) -> float:
    """Seconds to pause after something has failed so many times: exponential, with full jitter."""
    return random.uniform(0, min(LONGEST_PAUSE, PAUSE * 2**times))
