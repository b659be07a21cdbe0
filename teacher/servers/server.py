"""Client of one OpenAI-compatible server."""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TypeVar

import openai

from dynapix.conf.errors import UserError
from dynapix.conf.proxies import proxy_hint
from dynapix.conf.schema import ServersConfig
from dynapix.teacher.servers.capabilities import Capabilities, Constraint, Messages, RequestFields
from dynapix.teacher.servers.responses import Response, ScoredPrompt, parse_completion

Reply = TypeVar("Reply")
Client = TypeVar("Client", openai.OpenAI, openai.AsyncOpenAI)

MALFORMED_REPLY_ERRORS = (AttributeError, IndexError, TypeError, ValueError)
"""Errors that the openai client or `parse_completion` raises for a reply that does not follow the
API."""
RETRYABLE_STATUSES = (408, 409)
"""HTTP status codes below 500 after which a retry may succeed: request timeout and conflict."""
LONGEST_REASON = 400
"""Maximum number of characters of a server's error that messages show."""
API_KEY_VARIABLE = "OPENAI_API_KEY"
"""The API key is in an environment variable because settings are saved with the run."""


def get_api_key() -> str:
    """Return the API key of the environment, or a placeholder: the openai client requires a key.

    Raises:
        UserError: The key has characters that no HTTP header can have.
    """
    key = os.environ.get(API_KEY_VARIABLE, "").strip()
    if not key.isascii() or not key.isprintable():
        raise UserError(
            f"the environment variable {API_KEY_VARIABLE} has characters that no API key has, such "
            "as a line break: set it again",
            code="invalid-api-key",
        )
    return key or "none"


def open_client(kind: type[Client], url: str, timeout: float) -> Client:
    """Return a client of a server that repeats no request.

    Raises:
        UserError: The environment names a proxy for the server that cannot be used, or an API key
            with invalid characters.
    """
    options = {"base_url": url, "api_key": get_api_key(), "max_retries": 0, "timeout": timeout}
    try:
        return kind(**options)
    except Exception as error:  # That of a missing package, or of an address that is none.
        if hint := proxy_hint(url):
            raise UserError(f"{url} cannot be reached ({error}){hint}", code="proxy") from error
        # The proxy is that of other hosts.
        is_async = kind is openai.AsyncOpenAI
        transport = openai.DefaultAsyncHttpxClient if is_async else openai.DefaultHttpxClient
        return kind(**options, http_client=transport(trust_env=False))


def authentication_error(url: str, error: openai.APIStatusError) -> UserError:
    """Return the error for a server that rejects the API key."""
    return UserError(
        f"{url} rejects the API key ({error.message}): set the environment variable "
        f"{API_KEY_VARIABLE} to a key of that server",
        code="invalid-api-key",
    )


class RequestError(Exception):
    """A request failed. `pause` is the time (s) to wait that the server gives, `status` its HTTP
    status, if any."""

    def __init__(self, problem: str, pause: float | None = None, status: int | None = None) -> None:
        super().__init__(problem)
        self.pause, self.status = pause, status


class MalformedReplyError(RequestError):
    """The server's reply does not follow the API."""


class RefusedError(RequestError):
    """The server refuses this request, and would refuse it again."""


class RateLimitedError(RequestError):
    """The server limits the request rate."""


class NoReplyInTimeError(RequestError):
    """The server sent no response within the timeout."""


class ServerClient:
    """Sends requests to `cfg.model` at `url`. Use it inside one event loop.

    Attributes:
        found: What the server takes; None as long as it was not probed.
        probe: The probe that sets `found`, if it has begun.
        in_flight: Number of requests that have no response yet.
        limit: Maximum of `in_flight`; lowered when the server is too slow.
        answered: Number of responses so far.
        lowered_at: Time of the last lowering, on the clock of time.monotonic().
        problem: Why `ServerPool` paused the server; None if the server has responded since.
        pauses: Number of consecutive pauses.
        available_at: Earliest time of the next request, on the clock of time.monotonic().
        checked_at: Time of the last canary, on the same clock.
        lock: Held while a canary is in flight.
    """

    def __init__(self, url: str, cfg: ServersConfig) -> None:
        self.url = url
        self.cfg = cfg
        self.client = open_client(openai.AsyncOpenAI, url, cfg.timeout)
        self.found: Capabilities | None = None
        self.probe: asyncio.Task[None] | None = None
        self.in_flight = self.pauses = self.answered = 0
        self.limit = float(cfg.concurrency)
        self.problem: str | None = None
        self.available_at = self.checked_at = self.lowered_at = -math.inf
        self.lock = asyncio.Lock()

    async def complete(
        self,
        messages: Messages,
        n: int,
        fields: RequestFields,
        constraint: Constraint | None = None,
    ) -> list[Response]:
        """Send a request in the form that the server takes, and return up to `n` responses.

        Raises:
            RequestError: The request failed.
            UserError: The server does not serve the model, or rejects the API key.
        """
        found = self.found or Capabilities()
        count = min(n, found.most or n)
        is_constrained = constraint is not None and found.form is not None

        async def request() -> list[Response]:
            completion = await self.client.chat.completions.create(
                model=self.cfg.model,
                messages=messages,
                n=count,
                **found.adapt(fields, constraint),
            )
            return parse_completion(completion, count, is_constrained)

        return await self._translate_errors(request)

    async def score(self, token_ids: Sequence[int]) -> ScoredPrompt:
        """Return the log-probabilities that the model gives the tokens of a prompt.

        Raises:
            RequestError: The request failed.
            UserError: The server does not serve the model, rejects the API key, or returns no
                log-probabilities of prompts.
        """

        async def request() -> ScoredPrompt:
            completion = await self.client.completions.create(
                model=self.cfg.model, prompt=list(token_ids), echo=True, logprobs=0, max_tokens=0
            )
            found = completion.choices[0].logprobs
            count = len(token_ids)
            if (
                found is None
                or len(found.tokens or ()) != count
                or len(found.token_logprobs or ()) != count
                or None in found.token_logprobs[1:]
            ):
                raise UserError(
                    f"{self.url} returns no log-probabilities of prompts: serve the model with a "
                    "server that answers completions with echo and logprobs, such as vLLM",
                    code="no-prompt-logprobs",
                )
            return ScoredPrompt(found.tokens, found.token_logprobs)

        return await self._translate_errors(request)

    async def change_adapter(self, action: str, name: str, folder: Path | None = None) -> None:
        """Load the adapter in a folder under a name, or unload it (`action`).

        Raises:
            RequestError: The request failed.
            UserError: The server loads no adapters, or rejects the API key.
        """
        body = {"lora_name": name} | ({"lora_path": str(folder)} if folder else {})

        async def request() -> None:
            try:
                await self.client.post(f"/{action}_lora_adapter", cast_to=str, body=body)
            except openai.AuthenticationError:
                raise
            except openai.NotFoundError as error:
                # vLLM also answers 404 if it finds no adapters in the folder.
                if name in error.message:
                    raise RefusedError(error.message) from error
                raise UserError(
                    f"{self.url} loads no adapters while it runs: start it with python -m "
                    "teacher.serve frames=true adapter_rank=RANK",
                    code="no-adapters",
                ) from error
            except openai.APIStatusError as error:
                # For adapters that do not fit, vLLM answers 500 with the reason.
                raise RefusedError(error.message) from error

        await self._translate_errors(request)

    async def _translate_errors(self, request: Callable[[], Awaitable[Reply]]) -> Reply:
        """Send a request, and raise the errors of `complete` instead of the openai library's."""
        cfg = self.cfg
        try:
            # The openai client's own timeout starts again with every byte that arrives.
            async with asyncio.timeout(cfg.timeout):
                return await request()
        except openai.NotFoundError as error:
            raise await self._unknown_model_error(_reason(error)) from error
        except openai.AuthenticationError as error:
            raise authentication_error(self.url, error) from error
        except openai.RateLimitError as error:
            raise RateLimitedError(
                f"rate-limited ({_reason(error)})", _retry_after(error)
            ) from error
        except openai.APIStatusError as error:
            if error.status_code >= 500 or error.status_code in RETRYABLE_STATUSES:
                reason = f"{_reason(error)}{proxy_hint(self.url)}"
                raise RequestError(reason, status=error.status_code) from error
            raise RefusedError(_reason(error)) from error
        except (openai.APITimeoutError, TimeoutError) as error:
            raise NoReplyInTimeError(
                f"no response within {cfg.GROUP}.timeout={cfg.timeout:g} seconds"
                f"{proxy_hint(self.url)}"
            ) from error
        except openai.APIConnectionError as error:
            cause = error.__cause__ or error
            raise RequestError(f"{cause}{proxy_hint(self.url)}") from error
        except (openai.APIResponseValidationError, *MALFORMED_REPLY_ERRORS) as error:
            raise MalformedReplyError(f"{type(error).__name__}: {error}") from error

    async def _unknown_model_error(self, reason: str) -> UserError:
        try:
            served = ", ".join([m.id async for m in self.client.models.list()])
        except (openai.OpenAIError, *MALFORMED_REPLY_ERRORS):
            served = "an unknown set of models"
        return UserError(
            f"{self.url} does not serve {self.cfg.GROUP}.model={self.cfg.model} ({reason}); it "
            f"serves {served}. Check that the URL belongs to an OpenAI-compatible server and ends "
            "in /v1",
            code="unknown-model",
        )


def _reason(error: openai.APIStatusError) -> str:
    """Return a server's error on one line, with its body."""
    # The openai client includes the body only if it has the form of OpenAI's errors.
    text = error.message if " - " in error.message else f"{error.message} - {error.body or ''}"
    return " ".join(text.split())[:LONGEST_REASON]


def _retry_after(error: openai.APIStatusError) -> float | None:
    """Return the seconds of the Retry-After header; None if it is missing or a date."""
    try:
        return max(0.0, float(error.response.headers.get("retry-after", "")))
    except ValueError:
        return None
