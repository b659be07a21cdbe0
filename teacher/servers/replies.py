"""What a server's reply amounts to."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Reply:
    """A server's answer. `flaw` says why its text is none, whatever it reads."""

    text: str
    flaw: str | None = None
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    finished: float | None = None


def replies(completion: Any, n: int) -> list[Reply]:
    """The first `n` choices of a chat completion. Raises ValueError where there is none."""
    choices = completion.choices[:n]
    if not choices:
        raise ValueError("it has no choices")
    read, written = _usage(completion)
    given = []
    for k, choice in enumerate(choices):
        share = None if written is None else (written + k) // len(choices)
        prompt = None if read is None else read * (k == 0)
        # A teacher may answer with half of a surrogate pair, which no file can hold.
        text = (choice.message.content or "").encode("utf-8", "replace").decode().strip()
        given.append(Reply(text, _flaw(text, choice), prompt, share, time.time()))
    return given


def _usage(completion: Any) -> tuple[int | None, int | None]:
    usage = completion.usage
    return (usage.prompt_tokens, usage.completion_tokens) if usage else (None, None)


def _flaw(text: str, choice: Any) -> str | None:
    if choice.finish_reason == "length":
        return "cut off"
    thought = getattr(choice.message, "reasoning_content", None) or getattr(
        choice.message, "reasoning", None
    )
    if thought or "<think>" in text or "</think>" in text:
        return "thinking"
    return None if text else "empty"
