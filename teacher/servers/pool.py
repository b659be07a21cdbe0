"""Load balancing over several servers.

While a server is down, restarting or busy, its requests go to another server or wait. A
request fails only if servers refuse it, or repeatedly fail on it, while they answer other requests.
A server that is too slow gets fewer requests at a time.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from dynapix.conf.errors import UserError
from dynapix.conf.schema import ServersConfig
from dynapix.teacher.servers.capabilities import (
    CANARY,
    OPTIONAL,
    Capabilities,
    Constraint,
    Messages,
    RequestFields,
    describe,
    find_capabilities,
    optional_fields,
)
from dynapix.teacher.servers.responses import Response, ScoredPrompt
from dynapix.teacher.servers.server import (
    MalformedReplyError,
    NoReplyInTimeError,
    RateLimitedError,
    RefusedError,
    RequestError,
    ServerClient,
)

log = logging.getLogger(__name__)
Job = TypeVar("Job")
Reply = TypeVar("Reply")

PAUSE, LONGEST_PAUSE = 0.5, 10.0
"""The upper bound (s) of a random pause before a retry is PAUSE, doubled with each failure, and at
most LONGEST_PAUSE."""
MAX_FAILURES = 4
"""Number of failures after which a request is given up, if the servers answer other requests."""
OVERLOAD_ERRORS = (NoReplyInTimeError, RateLimitedError)
RAISE = 1 / 16
"""By how much a response raises the number of requests at a time after it was lowered."""


class NoResponseError(Exception):
    """Servers that answer other requests do not answer this one."""


class ServerPool:
    """Sends requests to `cfg.model` at `cfg.urls`, each to the least busy server that is available.

    Use it as a context manager inside one event loop. Before its first request, a server is probed:
    which of the optional fields it takes, how many responses a request may have, and whether it
    applies the constraint. The log says so, and requests are sent in the form that it takes.

    Args:
        cfg: Settings of the servers.
        fields: Fields of every request.
        canary: A prompt that any working server answers. It is sent after another request failed:
            if the canary succeeds, the fault is in the request; if it fails too, in the server.
        constraint: What every response is constrained to, where the server can; `Response` says
            whether it was.
        samples: Maximum number of responses to a request.
        show: Called with the number of timeouts and of requests at a time when they change.
    """

    def __init__(
        self,
        cfg: ServersConfig,
        fields: RequestFields,
        canary: Messages = CANARY,
        constraint: Constraint | None = None,
        samples: int = 1,
        show: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.cfg, self.fields, self.canary = cfg, fields, canary
        self.constraint, self.samples, self.show = constraint, samples, show
        self.servers = [ServerClient(url, cfg) for url in dict.fromkeys(cfg.urls)]
        self.timeouts = 0
        self.failing_since: float | None = None
        """Time of the first pause of a server since the last response of any server."""

    async def __aenter__(self) -> ServerPool:
        return self

    async def __aexit__(self, *_: object) -> None:
        for server in self.servers:
            if server.probe is not None:
                server.probe.cancel()
        await asyncio.gather(*(server.client.close() for server in self.servers))

    async def complete(self, messages: Messages, n: int = 1, **fields: object) -> list[Response]:
        """Return up to `n` responses to a prompt, after waiting for a server if necessary. There
        are fewer if the server takes fewer at a time.

        Args:
            fields: Fields of this request only, in addition to those of every request.

        Raises:
            NoResponseError: A server that answers the canary refuses this prompt, or the prompt
                failed MAX_FAILURES times at such servers.
            UserError: No server was available for `cfg.unreachable_timeout` seconds, or a server
                does not serve the model, rejects the API key, refuses every request, or does not
                follow OpenAI's API.
        """
        fields = self.fields | fields
        return await self._request(lambda s: s.complete(messages, n, fields, self.constraint))

    async def takes(self, messages: Messages, **fields: object) -> bool:
        """Return whether a server that answers the canary answers a prompt, too.

        Raises:
            UserError: As in `complete`.
        """
        try:
            await self.complete(messages, **fields)
        except NoResponseError:
            return False
        return True

    async def score(self, token_ids: Sequence[int]) -> ScoredPrompt:
        """Return the log-probabilities of a prompt's tokens, after waiting for a server if
        necessary. It raises the errors of `complete`, and those of `ServerClient.score`."""
        return await self._request(lambda server: server.score(token_ids))

    async def load_adapter(self, folder: Path) -> None:
        """Load an adapter on every server under the name `cfg.model`.

        Raises:
            NoResponseError: A server cannot load it, or was not available for
                `cfg.unreachable_timeout` seconds.
            UserError: A server loads no adapters, or rejects the API key.
        """
        await asyncio.gather(*(self._load_adapter(server, folder) for server in self.servers))

    async def _load_adapter(self, server: ServerClient, folder: Path) -> None:
        end = time.monotonic() + self.cfg.unreachable_timeout
        for failures in itertools.count(1):
            try:
                return await server.change_adapter("load", self.cfg.model, folder)
            except RequestError as error:
                if isinstance(error, RefusedError) or time.monotonic() > end:
                    raise NoResponseError(f"{server.url}: {error}") from error
            await asyncio.sleep(random_pause(failures))

    async def unload_adapter(self, name: str) -> None:
        """Unload the adapter `name` on every server that has it."""
        for server in self.servers:
            # A server that was started again does not have it.
            with suppress(RequestError):
                await server.change_adapter("unload", name)

    async def _request(self, send: Callable[[ServerClient], Awaitable[Reply]]) -> Reply:
        """Return the reply of the first server that answers a request."""
        failures = 0
        while True:
            server = await self._wait_for_server()
            try:
                await self._probe(server)
                return await self._send(server, send)
            except RateLimitedError as limit:
                self._pause(server, limit)
            except RequestError as error:
                if not await self._answers_canary(server):
                    continue
                failures += 1
                if failures == MAX_FAILURES or isinstance(error, RefusedError):
                    raise NoResponseError(str(error)) from error
                await asyncio.sleep(random_pause(failures))

    async def _send(
        self,
        server: ServerClient,
        send: Callable[[ServerClient], Awaitable[Reply]],
        is_canary: bool = False,
    ) -> Reply:
        server.in_flight += 1
        sent, answered = time.monotonic(), server.answered
        try:
            reply = await send(server)
        except RequestError as error:
            # A server that has not answered yet may be loading its model.
            is_full = error.status == 503 and server.answered and server.problem is None
            if not is_canary and (is_full or isinstance(error, OVERLOAD_ERRORS)):
                self.timeouts += isinstance(error, NoReplyInTimeError)
                # Requests that were in flight together are too many only once.
                if sent > server.lowered_at:
                    self._lower_limit(server, server.answered - answered, error)
                self._show_limits()
            raise
        finally:
            server.in_flight -= 1
        server.answered += 1
        before, server.limit = server.limit, min(self.cfg.concurrency, server.limit + RAISE)
        if int(server.limit) > int(before):
            self._show_limits()
        server.problem, server.pauses, self.failing_since = None, 0, None
        return reply

    def _lower_limit(self, server: ServerClient, answered: int, error: RequestError) -> None:
        """Send at most half as many requests at a time to a server.

        Args:
            answered: How many others the server answered while the failed request waited. It takes
                at most half as many at a time; 0 says nothing.
        """
        before = int(server.limit)
        server.limit = max(1, min(before, answered or before) // 2)
        server.lowered_at = time.monotonic()
        if int(server.limit) < before:
            log.info(
                f"{server.url} does not keep up with {before} requests at a time ({error}): it now "
                f"gets at most {int(server.limit)}, and more as it answers"
            )

    def _show_limits(self) -> None:
        limit = min(self.cfg.concurrency, sum(int(server.limit) for server in self.servers))
        self.show(f"{self.timeouts} timeouts, {limit} at a time")

    async def _probe(self, server: ServerClient) -> None:
        """Find out what a server takes, unless it is known or nothing is asked for that it may not
        take. All requests that wait for the server share the probe and its error.

        Raises:
            RequestError: The server does not answer, or refuses even the bare canary.
        """
        is_needed = optional_fields(self.fields) or self.constraint is not None or self.samples > 1
        if server.found is None and is_needed:
            if server.probe is None or server.probe.done():
                server.probe = asyncio.create_task(self._find_capabilities(server))
            await asyncio.shield(server.probe)

    async def _find_capabilities(self, server: ServerClient) -> None:
        async def ask(extra: RequestFields, n: int, length: int = 1) -> list[Response] | None:
            fields = {**self.fields, "max_tokens": length, "extra_body": extra}
            try:
                return await self._send(server, lambda s: s.complete(CANARY, n, fields))
            except RequestError as error:
                is_bare = not extra and n == 1
                if is_bare or not (isinstance(error, RefusedError) or error.status == 500):
                    raise
                await ask({}, 1)
                return None

        wanted = self.fields, self.constraint, self.samples
        server.found = await find_capabilities(ask, *wanted)
        log.info(f"{server.url} {describe(server.found, *wanted)}")
        if self.constraint is not None and server.found.form is None:
            log.warning(
                f"{server.url} does not apply the constraint that was asked for: its responses are "
                "not constrained, and are recorded as such"
            )

    async def _wait_for_server(self) -> ServerClient:
        """Wait until a server is available, and return the one with the fewest requests in flight.

        Raises:
            UserError: No server was available for `cfg.unreachable_timeout` seconds.
        """
        while not (available := [s for s in self.servers if is_available(s)]):
            since = self.failing_since or time.monotonic()
            if time.monotonic() - since > self.cfg.unreachable_timeout:
                group = self.cfg.GROUP
                problems = "; ".join(f"{server.url}: {server.problem}" for server in self.servers)
                raise UserError(
                    f"no server of {group}.url answered for {group}.unreachable_timeout="
                    f"{self.cfg.unreachable_timeout:g} seconds ({problems}): start one and run the "
                    "same command again, which resumes",
                    code="no-server",
                )
            # Random, so that waiting requests do not resume all at once.
            await asyncio.sleep(random.uniform(0, PAUSE))
        return min(available, key=lambda server: server.in_flight)

    def _pause(self, server: ServerClient, error: RequestError) -> None:
        """Send no requests to a server for the time that its rate limit gives, or otherwise for a
        random time whose bound doubles with each consecutive pause."""
        now = time.monotonic()
        # Requests that were in flight together fail together, and count as one pause.
        server.pauses += server.available_at <= now
        pause = random_pause(server.pauses) if error.pause is None else error.pause
        server.available_at = max(server.available_at, now + pause)
        server.problem = str(error)
        self.failing_since = self.failing_since or now

    async def _answers_canary(self, server: ServerClient) -> bool:
        """Send the canary to a server at which a request failed, and return whether it succeeds. If
        not, the server is paused.

        Raises:
            UserError: The server refuses the canary or does not follow OpenAI's API.
        """
        failed_at = time.monotonic()
        # One canary is enough for all requests that failed before it was sent.
        async with server.lock:
            if server.checked_at < failed_at:
                server.checked_at = time.monotonic()
                url = server.url
                try:
                    fields = self.fields | {"max_tokens": 1}
                    if server.found is None:
                        fields = Capabilities(frozenset(OPTIONAL)).adapt(fields, None)
                    canary = self.canary, 1, fields, self.constraint
                    await self._send(server, lambda s: s.complete(*canary), is_canary=True)
                except RefusedError as error:
                    raise UserError(
                        f"{url} refuses every request ({error}): check the server's log and the "
                        f"settings {self.cfg.GROUP}.*",
                        code="server-refuses",
                    ) from error
                except MalformedReplyError as error:
                    raise UserError(
                        f"{url} does not answer like an OpenAI-compatible server ({error}): check "
                        "the URL, which ends in /v1",
                        code="incompatible-server",
                    ) from error
                except RequestError as error:
                    if server.problem is None:
                        log.info(f"{url} does not answer ({error}); waiting for it")
                    self._pause(server, error)
        return server.problem is None


def is_available(server: ServerClient) -> bool:
    """Return whether a server may get a request now."""
    return server.available_at <= time.monotonic() and server.in_flight < int(server.limit)


def random_pause(failures: int) -> float:
    """Return a pause (s) after a number of failures: exponential backoff with full jitter."""
    return random.uniform(0, min(LONGEST_PAUSE, PAUSE * 2**failures))


async def run_limited(
    jobs: Sequence[Job], limit: int, run: Callable[[Job], Awaitable[None]]
) -> None:
    """Await `run(job)` for every job, with at most `limit` jobs in progress at a time.

    Jobs start in order. If a job raises an error, no further job starts, the jobs in progress are
    cancelled, and the error is raised.
    """
    waiting = iter(jobs)

    async def work() -> None:
        for job in waiting:
            await run(job)

    workers = [asyncio.create_task(work()) for _ in range(min(limit, len(jobs)))]
    try:
        await asyncio.gather(*workers)
    finally:
        for worker in workers:
            worker.cancel()
        await asyncio.gather(*workers, return_exceptions=True)
