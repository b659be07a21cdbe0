"""Load balancing over several servers, with recovery from outages.

A server that is down, restarting or busy costs time but none of an item's attempts.
"""

from __future__ import annotations

import asyncio
import logging
import math
import random
import time

from conf.errors import UserError
from conf.schema import ServersConfig
from teacher.servers.responses import Response
from teacher.servers.server import (
    MalformedReplyError,
    Messages,
    RateLimitedError,
    RefusedError,
    RequestError,
    RequestFields,
    Server,
)

log = logging.getLogger(__name__)

PAUSE, LONGEST_PAUSE = 0.5, 10.0
"""Upper bounds (seconds) of the first pause before a retry, and of any pause."""
MAX_FAILURES = 4
"""Failures in a row, at servers that are up, after which a request is tested against CANARY."""
CANARY: Messages = [{"role": "user", "content": "Say hello."}]
"""A prompt that any working server answers: it distinguishes a broken server from a prompt that
cannot be answered."""


class NoResponseError(Exception):
    """Servers that answer other requests do not answer this one."""


class ServerState:
    """A server of the pool and its condition."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.in_flight = 0
        self.problem: str | None = None
        """Why the server is out of use; None while it is in use."""
        self.available_at = -math.inf
        """Earliest time of the next request, on the clock of time.monotonic()."""
        self.rate_limits = 0
        """Rate-limited responses in a row."""
        self.health_lock = asyncio.Lock()
        self.checked_at = -math.inf
        self.recovery: asyncio.Task[None] | None = None

    @property
    def is_ready(self) -> bool:
        return self.problem is None and self.available_at <= time.monotonic()

    def back_off(self, limit: RateLimitedError) -> None:
        """Send nothing for as long as the server asks."""
        now = time.monotonic()
        # Requests that were in flight together are limited together and count once.
        self.rate_limits += self.available_at <= now
        seconds = limit.seconds if limit.seconds is not None else random_pause(self.rate_limits)
        self.available_at = max(self.available_at, now + seconds)


class ServerPool:
    """Sends requests to `cfg.model` at `cfg.urls`, each to the least busy server that is up.

    Use it as a context manager inside one event loop.

    Args:
        cfg: The servers.
        fields: Fields of every request.
        canary: A prompt that any working server of this kind answers.
        kind: The client class of one server.
    """

    def __init__(
        self,
        cfg: ServersConfig,
        fields: RequestFields,
        canary: Messages = CANARY,
        kind: type[Server] = Server,
    ) -> None:
        self.cfg, self.fields, self.canary = cfg, fields, canary
        self.states = [ServerState(kind(url, cfg)) for url in dict.fromkeys(cfg.urls)]
        self.stuck_since: float | None = None
        """Since when no server has been ready, with no response in between."""

    async def __aenter__(self) -> ServerPool:
        await asyncio.gather(*(self._is_up(state) for state in self.states))
        return self

    async def __aexit__(self, *_: object) -> None:
        recoveries = [state.recovery for state in self.states if state.recovery]
        for recovery in recoveries:
            recovery.cancel()
        await asyncio.gather(*recoveries, return_exceptions=True)
        await asyncio.gather(*(state.server.close() for state in self.states))

    async def complete(self, messages: Messages, n: int = 1, **fields: object) -> list[Response]:
        """Up to `n` responses to a prompt, however long servers have to be waited for.

        Args:
            messages: The prompt.
            n: Number of responses.
            fields: Fields of this request only.

        Raises:
            NoResponseError: Servers that are up refuse this prompt or fail at it repeatedly.
            UserError: No server was ready for `cfg.patience` seconds, or a server does not serve
                the model, refuses every request, or does not follow OpenAI's API.
        """
        failures = 0
        while True:
            state = await self._wait_for_server()
            try:
                return await self._send(state, messages, n, self.fields | fields)
            except RateLimitedError as limit:
                state.back_off(limit)
                continue
            except RequestError as error:
                if not await self._is_up(state):
                    continue
                failures += 1
                if failures == MAX_FAILURES or isinstance(error, RefusedError):
                    if await self._answers_canary(state):
                        raise NoResponseError(str(error)) from error
                    failures = 0
            await asyncio.sleep(random_pause(failures))

    async def _send(
        self, state: ServerState, messages: Messages, n: int, fields: RequestFields
    ) -> list[Response]:
        state.in_flight += 1
        try:
            responses = await state.server.complete(messages, n, fields)
        finally:
            state.in_flight -= 1
        state.rate_limits, self.stuck_since = 0, None
        return responses

    async def _wait_for_server(self) -> ServerState:
        """The least busy server that is ready. Raises UserError when patience runs out."""
        while not (ready := [state for state in self.states if state.is_ready]):
            self.stuck_since = self.stuck_since or time.monotonic()
            if time.monotonic() - self.stuck_since > self.cfg.patience:
                raise self._no_server_error()
            # Random, so that waiting requests do not resume all at once.
            await asyncio.sleep(random.uniform(0, PAUSE))
        return min(ready, key=lambda state: state.in_flight)

    async def _is_up(self, state: ServerState) -> bool:
        """Check a server's health, and start its recovery if it is down."""
        failed_at = time.monotonic()
        # One check serves all requests that failed before it.
        async with state.health_lock:
            if state.problem is None and state.checked_at < failed_at:
                problem = await state.server.check_health()
                state.checked_at = time.monotonic()
                if problem is not None:
                    self._take_out_of_use(state, problem)
        return state.problem is None

    def _take_out_of_use(self, state: ServerState, problem: str, healthy: bool = False) -> None:
        """`healthy`: the health page reports no problem, so only the canary shows a recovery."""
        log.info(f"{state.server.url} is down ({problem}); waiting for it")
        state.problem = problem
        state.recovery = asyncio.create_task(self._recover(state, healthy))

    async def _recover(self, state: ServerState, healthy: bool) -> None:
        checks = 0
        while state.problem is not None:
            checks += 1
            await asyncio.sleep(random_pause(checks))
            problem = await state.server.check_health()
            if problem is None and healthy:
                try:
                    problem = await self._send_canary(state)
                except (RequestError, UserError) as error:
                    problem = str(error)
            state.problem = problem
        log.info(f"{state.server.url} is up again")

    async def _answers_canary(self, state: ServerState) -> bool:
        """Send the canary, and take the server out of use if it fails.

        Raises:
            UserError: The server refuses the canary or does not follow OpenAI's API.
        """
        try:
            problem = await self._send_canary(state)
        except RefusedError as error:
            raise UserError(
                f"{state.server.url} refuses every request ({error}): check the server's log and "
                f"the settings {self.cfg.GROUP}.*",
                code="server-refuses",
            ) from error
        except MalformedReplyError as error:
            raise UserError(
                f"{state.server.url} does not answer like an OpenAI-compatible server ({error}): "
                "check the URL, which ends in /v1",
                code="incompatible-server",
            ) from error
        if problem is not None and state.problem is None:
            self._take_out_of_use(state, problem, healthy=True)
        return problem is None

    async def _send_canary(self, state: ServerState) -> str | None:
        """Why the canary got no response, or None. Raises RefusedError and MalformedReplyError."""
        try:
            await self._send(state, self.canary, 1, self.fields | {"max_tokens": 1})
        except (MalformedReplyError, RefusedError):
            raise
        except RequestError as error:
            return str(error)
        return None

    def _no_server_error(self) -> UserError:
        problems = "; ".join(
            f"{state.server.url}: {state.problem or 'rate-limited (HTTP 429)'}"
            for state in self.states
        )
        group, patience = self.cfg.GROUP, self.cfg.patience
        return UserError(
            f"no server of {group}.url was ready for {group}.patience={patience:g} seconds "
            f"({problems}): start one and run the same command again, which resumes",
            code="no-server",
        )


def random_pause(failures: int) -> float:
    """Seconds to wait after a number of failures: exponential backoff with full jitter."""
    return random.uniform(0, min(LONGEST_PAUSE, PAUSE * 2**failures))
