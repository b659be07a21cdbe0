"""Parse the responses of a chat server."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

TRUNCATED = "cut off"
"""Value of `Response.flaw` for a response that reached the token limit."""


@dataclass(frozen=True)
class Response:
    """One response to a prompt.

    Attributes:
        text: The response without surrounding white space.
        flaw: Why the response cannot be used, whatever its text is; None if it can be.
        prompt_tokens: Number of tokens of the prompt, in the first response to a request; 0 in its
            other responses. None if the server does not report it.
        completion_tokens: Number of generated tokens: an equal share of the request's total. None
            if the server does not report it.
        finished: Arrival time (Unix time, s).
        reasoning: The text that the server's reasoning parser separated from the response.
        token_ids: The token ids of the response, if the request asks for them with vLLM's
            `return_token_ids`; otherwise empty.
        prompt_ids: The same for the prompt.
        log_probabilities: The log-probability (nat) of each token of the response, if the request
            asks for them with `logprobs`; otherwise empty.
        constrained: Whether the server constrained the response to a grammar or a schema.
    """

    text: str
    flaw: str | None = None
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    finished: float | None = None
    reasoning: str = ""
    token_ids: tuple[int, ...] = ()
    prompt_ids: tuple[int, ...] = ()
    log_probabilities: tuple[float, ...] = ()
    constrained: bool = False


@dataclass(frozen=True)
class ScoredPrompt:
    """The text and the log-probability (nat) of each token of a prompt. The first token, which
    nothing precedes, has none."""

    tokens: list[str]
    log_probabilities: list[float | None]


def parse_completion(completion: Any, n: int, is_constrained: bool = False) -> list[Response]:
    """Convert the first `n` choices of the openai library's chat completion to responses.

    Args:
        is_constrained: Whether the responses were constrained to a grammar or a schema, which
            allows no thought: a server's reasoning parser may put the whole response into
            `reasoning`.

    Raises:
        ValueError: The completion has no choices.
    """
    choices, usage = completion.choices[:n], completion.usage
    if not choices:
        raise ValueError("it has no choices")
    responses = []
    for k, choice in enumerate(choices):
        message, text = choice.message, _clean(choice.message.content)
        reasoning = _clean(
            getattr(message, "reasoning_content", None) or getattr(message, "reasoning", None)
        )
        scored = getattr(getattr(choice, "logprobs", None), "content", None) or ()
        if is_constrained and not text and choice.finish_reason != "length":
            text, reasoning = reasoning, ""
        responses.append(
            Response(
                text=text,
                flaw=_find_flaw(text, reasoning, choice.finish_reason),
                prompt_tokens=usage and usage.prompt_tokens * (k == 0),
                completion_tokens=usage and (usage.completion_tokens + k) // len(choices),
                finished=time.time(),
                reasoning=reasoning,
                token_ids=tuple(getattr(choice, "token_ids", None) or ()),
                prompt_ids=tuple(getattr(completion, "prompt_token_ids", None) or ()),
                log_probabilities=tuple(token.logprob for token in scored),
                constrained=is_constrained,
            )
        )
    return responses


def _clean(text: str | None) -> str:
    # A model may generate an unpaired surrogate, which UTF-8 cannot encode.
    return (text or "").encode("utf-8", "replace").decode().strip()


def _find_flaw(text: str, reasoning: str, finish_reason: str) -> str | None:
    if finish_reason == "length":
        return TRUNCATED
    if reasoning or "<think>" in text or "</think>" in text:
        return "thinking"
    return None if text else "empty"
