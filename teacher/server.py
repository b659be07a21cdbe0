"""The client of an OpenAI-compatible server. A server that is down costs time, not attempts."""

from __future__ import annotations

import asyncio
import http.client
import time
import urllib.error
import urllib.request
from dataclasses import dataclass

import openai

from conf.errors import UserError
from conf.schema import TeacherConfig

PAUSE, LONGEST_PAUSE = 0.5, 5.0
"""Seconds between looks at a server that is down: the first, doubled up to the longest."""


NO_REPLY = (AttributeError, IndexError, TypeError, ValueError)
"""What the client raises at a reply that is not of the API's form."""


@dataclass(frozen=True)
class Reply:
    """A server's answer; `cut_off` where it ran into the token limit."""

    text: str
    cut_off: bool


class Server:
    """Asks `cfg.model` at `cfg.url`. Use it inside one event loop."""

    def __init__(self, cfg: TeacherConfig) -> None:
        self.cfg = cfg
        self.client = openai.AsyncOpenAI(
            base_url=cfg.url, api_key="none", max_retries=0, timeout=cfg.timeout
        )
        self.health = f"{cfg.url.rstrip('/').removesuffix('/v1')}/health"
        self.looking = asyncio.Lock()

    async def ask(self, messages: list[dict[str, str]]) -> Reply:
        """One answer to a chat, however often the server has to be waited for.

        Raises:
            UserError: the server stays down for longer than `cfg.patience`, does not know the
                model, or refuses the request.
        """
        deadline, pause = None, PAUSE
        while True:
            try:
                return await self._ask(messages)
            except openai.NotFoundError as error:
                raise await self._unknown_model() from error
            except (
                openai.APIConnectionError,
                openai.InternalServerError,
                openai.RateLimitError,
            ) as error:
                deadline = deadline or time.monotonic() + self.cfg.patience
                if time.monotonic() + pause > deadline:
                    raise self._gone(error) from error
            except openai.APIStatusError as error:
                raise UserError(f"{self.cfg.url} refused a request: {error.message}") from error
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)
            await self.wait(deadline)

    async def wait(self, deadline: float | None = None) -> None:
        """Return once the server answers; UserError if it does not before the deadline (in
        time.monotonic()'s seconds), or within `cfg.patience` seconds."""
        deadline = deadline or time.monotonic() + self.cfg.patience
        pause = PAUSE
        # One look at a time, for every request in flight waits here at once.
        async with self.looking:
            while (problem := await asyncio.to_thread(_problem, self.health)) is not None:
                if time.monotonic() + pause > deadline:
                    raise self._gone(problem)
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    async def _ask(self, messages: list[dict[str, str]]) -> Reply:
        cfg = self.cfg
        try:
            completion = await self.client.chat.completions.create(
                model=cfg.model,
                messages=messages,
                temperature=cfg.temperature,
                top_p=cfg.top_p,
                max_tokens=cfg.max_tokens,
                extra_body={"top_k": cfg.top_k, "chat_template_kwargs": {"enable_thinking": False}},
            )
            choice = completion.choices[0]
            return Reply((choice.message.content or "").strip(), choice.finish_reason == "length")
        except NO_REPLY as error:
            raise UserError(
                f"{cfg.url} does not answer as an OpenAI-compatible server does "
                f"({type(error).__name__}: {error}); such a URL ends in /v1"
            ) from error

    async def _unknown_model(self) -> UserError:
        try:
            served = ", ".join([m.id async for m in self.client.models.list()])
        except (openai.OpenAIError, *NO_REPLY):
            served = "an unknown set"
        return UserError(
            f"{self.cfg.url} does not serve teacher.model={self.cfg.model}; it has {served}. Is "
            "that the URL of an OpenAI-compatible server, ending in /v1?"
        )

    def _gone(self, problem: object) -> UserError:
        return UserError(
            f"teacher.url={self.cfg.url} has not answered for teacher.patience="
            f"{self.cfg.patience:g} seconds ({problem}); start the server and run this again, it "
            "goes on with what is answered"
        )


def _problem(health: str) -> str | None:
    """What is wrong with a server, None if it is up. One without a health page is up."""
    try:
        with urllib.request.urlopen(health, timeout=10):
            return None
    except urllib.error.HTTPError as error:
        return f"HTTP {error.code}" if error.code >= 500 else None
    except (OSError, http.client.HTTPException) as error:
        return str(error) or type(error).__name__
