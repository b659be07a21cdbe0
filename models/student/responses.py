"""Generated responses and the limits of their length."""

from __future__ import annotations

from dataclasses import dataclass

ANSWER_TOKENS = 16
"""Maximum number of new tokens in answer mode: enough for an answer line, even a malformed one."""
THOUGHT_TAG = "<think>"
"""Tag that opens a thought. Some chat templates end prompts with it."""


def response_token_limit(mode: str, max_new_tokens: int, thinking: bool = False) -> int:
    """Return the maximum number of new tokens: `ANSWER_TOKENS` in answer mode without thinking,
    otherwise `max_new_tokens`."""
    return ANSWER_TOKENS if mode == "answer" and not thinking else max_new_tokens


@dataclass(frozen=True)
class GeneratedText:
    """A generated text.

    Attributes:
        truncated: Whether it was cut off at the token limit.
        ids: Its token ids, with the one that ends it; empty if they are not known.
        log_probabilities: The log-probability (nat) of each of these tokens in the distribution
            that it was sampled from; empty if they are not known.
    """

    text: str
    truncated: bool = False
    ids: tuple[int, ...] = ()
    log_probabilities: tuple[float, ...] = ()
