"""Client of one OpenAI-compatible server."""

from __future__ import annotations

import asyncio
import math
import os
from typing import Any

import openai

from conf.errors import UserError
from conf.schema import ServersConfig
from teacher.servers.responses import Response, parse_completion

Messages = list[dict[str, Any]]
"""A prompt in the chat format."""
RequestFields = dict[str, Any]
"""Fields of a chat completion request; those outside OpenAI's API are in `extra_body`."""

MALFORMED_REPLY_ERRORS = (AttributeError, IndexError, TypeError, ValueError)
"""Errors that a body which does not follow the API raises in the openai client or while it is
parsed."""
RETRYABLE_STATUSES = (408, 409)
"""Client errors that a retry may resolve: request timeout and conflict."""
API_KEY_VARIABLE = "OPENAI_API_KEY"
"""An environment variable and not a setting, because settings are saved with the run."""


def get_api_key() -> str:
    """The API key from the environment; a placeholder if unset, since the client requires one."""
    return os.environ.get(API_KEY_VARIABLE) or "none"


def authentication_error(url: str, error: openai.APIStatusError) -> UserError:
    """The error for a server that rejects the API key."""
    return UserError(
        f"{url} rejects the API key ({error.message}): set the environment variable "
        f"{API_KEY_VARIABLE} to a key of that server",
        code="invalid-api-key",
    )


class RequestError(Exception):
    """A request that got no response; `pause` is the wait (s) that the server asks for, if any."""

    def __init__(self, problem: str, pause: float | None = None) -> None:
        super().__init__(problem)
        self.pause = pause


class MalformedReplyError(RequestError):
    """A body that does not follow the API."""


class RefusedError(RequestError):
    """The server refuses this request; a retry gets the same result."""


class RateLimitedError(RequestError):
    """The server limits the request rate."""


class Server:
    """Sends requests to `cfg.model` at `url`. Use it inside one event loop.

    Attributes:
        in_flight: Number of requests without a response yet.
        problem: Why the last request failed; None if it did not.
        pauses: Number of pauses in a row.
        available_at: Earliest time of the next request, on the clock of time.monotonic().
        checked_at: Time of the last canary.
        lock: Held while a canary is in flight.
    """

    def __init__(self, url: str, cfg: ServersConfig) -> None:
        self.url = url
        self.cfg = cfg
        self.client = openai.AsyncOpenAI(
            base_url=url, api_key=get_api_key(), max_retries=0, timeout=cfg.timeout
        )
        self.in_flight = self.pauses = 0
        self.problem: str | None = None
        self.available_at = self.checked_at = -math.inf
        self.lock = asyncio.Lock()

    async def complete(self, messages: Messages, n: int, fields: RequestFields) -> list[Response]:
        """Up to `n` responses to a prompt.

        Raises:
            RequestError: No response this time.
            UserError: The server does not serve the model, or rejects the API key.
        """
        cfg = self.cfg
        try:
            # The openai client's own timeout restarts with every byte that arrives.
            async with asyncio.timeout(cfg.timeout):
                completion = await self.client.chat.completions.create(
                    model=cfg.model, messages=messages, n=n, **fields
                )
                return parse_completion(completion, n)
        except openai.NotFoundError as error:
            raise await self._unknown_model_error() from error
        except openai.AuthenticationError as error:
            raise authentication_error(self.url, error) from error
        except openai.RateLimitError as error:
            raise RateLimitedError("rate-limited (HTTP 429)", _retry_after(error)) from error
        except openai.APIStatusError as error:
            if error.status_code >= 500 or error.status_code in RETRYABLE_STATUSES:
                raise RequestError(f"HTTP {error.status_code}") from error
            raise RefusedError(error.message) from error
        except (openai.APITimeoutError, TimeoutError) as error:
            raise RequestError(
                f"no response within {cfg.GROUP}.timeout={cfg.timeout:g} seconds"
            ) from error
        except openai.APIConnectionError as error:
            raise RequestError(str(error.__cause__ or error)) from error
        except (openai.APIResponseValidationError, *MALFORMED_REPLY_ERRORS) as error:
            raise MalformedReplyError(f"{type(error).__name__}: {error}") from error

    async def _unknown_model_error(self) -> UserError:
        try:
            served = ", ".join([m.id async for m in self.client.models.list()])
        except (openai.OpenAIError, *MALFORMED_REPLY_ERRORS):
            served = "an unknown set of models"
        return UserError(
            f"{self.url} does not serve {self.cfg.GROUP}.model={self.cfg.model}; it serves "
            f"{served}. Check that the URL is that of an OpenAI-compatible server and ends in /v1",
            code="unknown-model",
        )


def _retry_after(error: openai.APIStatusError) -> float | None:
    """Seconds to wait by the Retry-After header; None without one, or if it is a date."""
    try:
        return max(0.0, float(error.response.headers.get("retry-after", "")))
    except ValueError:
        return None
