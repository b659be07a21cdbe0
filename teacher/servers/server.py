"""One OpenAI-compatible server: how it is asked, and what can come back."""

from __future__ import annotations

import asyncio
import email.utils
import os
import time
from typing import Any

import openai

from conf.errors import UserError
from conf.schema import ServersConfig
from teacher.servers.health import health_problem
from teacher.servers.responses import Response, replies

Messages = list[dict[str, Any]]
RequestFields = dict[str, Any]
"""Fields of a chat completion's request, those outside the API's own in `extra_body`."""

MALFORMED_RESPONSE_ERRORS = (AttributeError, IndexError, TypeError, ValueError)
"""What the client raises at a reply that is not of the API's form."""


BUSY = (408, 409)
"""Statuses below 500 that another try may change: a timeout on the way, a conflict."""
KEY = "OPENAI_API_KEY"
"""The variable that holds the key of servers that want one: no setting, for those are written
down."""


def get_api_key() -> str:
    """The key; a server that wants none is content with any word, and the client wants one."""
    return os.environ.get(KEY) or "none"


def authentication_error(url: str, error: openai.APIStatusError) -> UserError:
    """What to tell a user whom a server does not let in."""
    return UserError(
        f"{url} does not accept the key that it was given ({error.message}): put that server's key "
        f"into the environment variable {KEY}"
    )


class RequestError(Exception):
    """A request without an answer."""


class MalformedReplyError(RequestError):
    """A reply that is not of the API's form."""


class RefusedError(RequestError):
    """The server will not answer this request, however often it is sent."""


class RateLimitedError(RequestError):
    """The server wants to be left alone, for `seconds` where it says so."""

    def __init__(self, problem: str, seconds: float | None) -> None:
        super().__init__(problem)
        self.seconds = seconds


class Server:
    """Asks `cfg.model` at `url`. Use it inside one event loop."""

    def __init__(self, url: str, cfg: ServersConfig) -> None:
        self.url = url
        self.cfg = cfg
        self.client = openai.AsyncOpenAI(
            base_url=url, api_key=get_api_key(), max_retries=0, timeout=cfg.timeout
        )

    async def complete(self, chat: Messages, n: int, request: RequestFields) -> list[Response]:
        """`n` answers to a chat.

        Raises:
            RequestError: there is no answer, this time.
            UserError: the server does not know the model, or the key.
        """
        cfg = self.cfg
        try:
            # The client's own timeout starts again with every byte that comes.
            async with asyncio.timeout(cfg.timeout):
                return await self._responses(chat, n, request)
        except openai.NotFoundError as error:
            raise await self._unknown_model() from error
        except openai.AuthenticationError as error:
            raise authentication_error(self.url, error) from error
        except openai.RateLimitError as error:
            raise RateLimitedError("HTTP 429", _retry_after(error)) from error
        except openai.InternalServerError as error:
            raise RequestError(f"HTTP {error.status_code}") from error
        except openai.APIStatusError as error:
            if error.status_code in BUSY:
                raise RequestError(f"HTTP {error.status_code}") from error
            raise RefusedError(error.message) from error
        except (openai.APITimeoutError, TimeoutError) as error:
            raise RequestError(
                f"no answer within {cfg.GROUP}.timeout={cfg.timeout:g} seconds"
            ) from error
        except openai.APIConnectionError as error:
            raise RequestError(str(error.__cause__ or error)) from error
        except (openai.APIResponseValidationError, *MALFORMED_RESPONSE_ERRORS) as error:
            raise MalformedReplyError(f"{type(error).__name__}: {error}") from error

    async def _responses(self, chat: Messages, n: int, request: RequestFields) -> list[Response]:
        """Errors are the client's own, and those of `NO_REPLY`."""
        completion = await self.client.chat.completions.create(
            model=self.cfg.model, messages=chat, n=n, **request
        )
        return replies(completion, n)

    async def health(self) -> str | None:
        """What is wrong with the server, None if it is up."""
        return await asyncio.to_thread(health_problem, self.url)

    async def close(self) -> None:
        await self.client.close()

    async def _unknown_model(self) -> UserError:
        try:
            served = ", ".join([m.id async for m in self.client.models.list()])
        except (openai.OpenAIError, *MALFORMED_RESPONSE_ERRORS):
            served = "an unknown set"
        return UserError(
            f"{self.url} does not serve {self.cfg.GROUP}.model={self.cfg.model}; it has {served}. "
            "Is that the URL of an OpenAI-compatible server, ending in /v1?"
        )


def _retry_after(error: openai.APIStatusError) -> float | None:
    """Seconds of a Retry-After header, which may also be a date."""
    header = error.response.headers.get("retry-after", "")
    try:
        return max(0.0, float(header))
    except ValueError:
        pass
    try:
        return max(0.0, email.utils.parsedate_to_datetime(header).timestamp() - time.time())
    except ValueError:
        return None
