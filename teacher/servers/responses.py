"""What a server's reply amounts to."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

TRUNCATED = "cut off"
"""The flaw of an answer that has as many tokens as it may have."""


@dataclass(frozen=True)
class Response:
    """A server's answer. `flaw` says why its text is none, whatever it reads; `thought` is what a
    server's reasoning parser has taken out of the text."""

    text: str
    flaw: str | None = None
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    finished: float | None = None
    reasoning: str = ""


def replies(completion: Any, n: int) -> list[Response]:
    """The first `n` choices of a chat completion. Raises ValueError where there is none."""
    choices = completion.choices[:n]
    if not choices:
        raise ValueError("it has no choices")
    read, written = _usage(completion)
    given = []
    for k, choice in enumerate(choices):
        share = None if written is None else (written + k) // len(choices)
        prompt = None if read is None else read * (k == 0)
        text, thought = _clean(choice.message.content), _clean(_thought(choice))
        flaw = _flaw(text, thought, choice)
        given.append(Response(text, flaw, prompt, share, time.time(), thought))
    return given


def _usage(completion: Any) -> tuple[int | None, int | None]:
    usage = completion.usage
    return (usage.prompt_tokens, usage.completion_tokens) if usage else (None, None)


def _thought(choice: Any) -> str | None:
    message = choice.message
    return getattr(message, "reasoning_content", None) or getattr(message, "reasoning", None)


def _clean(text: str | None) -> str:
    # A model may answer with half of a surrogate pair, which no file can hold.
    return (text or "").encode("utf-8", "replace").decode().strip()


def _flaw(text: str, thought: str, choice: Any) -> str | None:
    if choice.finish_reason == "length":
        return TRUNCATED
    if thought or "<think>" in text or "</think>" in text:
        return "thinking"
    return None if text else "empty"
