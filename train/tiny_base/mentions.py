"""Where a text speaks of which object, and of which picture."""

from __future__ import annotations

import re
from dataclasses import dataclass

from transformers import PreTrainedTokenizerBase

from data.records import COLORS, LETTERS, MATERIALS, SHAPES
from teacher.sections import SECTIONS

NAME = re.compile(" ".join(f"(?:{'|'.join(words)})" for words in (COLORS, MATERIALS, SHAPES)))
"""Matches the noun phrase of an object."""
EVENTS = re.compile(
    rf"(?P<name>{NAME.pattern})|[Cc]andidate (?P<letter>[{''.join(LETTERS)}])\b"
    rf"|(?P<section>{'|'.join(SECTIONS)}):|(?P<end>\.(?=\s|$))"
)


@dataclass(frozen=True)
class Mention:
    """A name in a text, and the tokens up to the next name or the end of the sentence.

    Attributes:
        last: Index of the name's last token.
        stop: Index of the first token that no longer speaks of the object.
        section: Title of the section of the rationale; None before the first.
        letter: The candidate that the text speaks of; None if it speaks of the scene.
        letter_at: Index of the token of the letter, if any.
    """

    name: str
    last: int
    stop: int
    section: str | None
    letter: str | None
    letter_at: int | None


def find_mentions(text: str, tokenizer: PreTrainedTokenizerBase) -> tuple[list[Mention], int]:
    """Return the mentions of objects in a text, and the number of its tokens."""
    encoded = tokenizer(text, add_special_tokens=False, return_offsets_mapping=True)
    offsets = encoded["offset_mapping"]
    token_ending = {end: k for k, (_, end) in enumerate(offsets)}
    mentions: list[Mention] = []
    section = letter = letter_at = None
    # The name that the text speaks of, and its last token.
    current: tuple[str, int] | None = None

    def close(at: int) -> None:
        nonlocal current
        if current is not None:
            # The token with the character at this position; a space belongs to the next word.
            stop = next(k for k, (_, end) in enumerate(offsets) if end > at)
            mentions.append(Mention(*current, stop, section, letter, letter_at))
            current = None

    for match in EVENTS.finditer(text):
        close(match.start())
        if match["name"] and match.end() in token_ending:
            current = match["name"], token_ending[match.end()]
        elif match["letter"]:
            letter, letter_at = match["letter"], token_ending.get(match.end())
        elif match["section"]:
            section, letter, letter_at = match["section"], None, None
    if current is not None:
        mentions.append(Mention(*current, len(offsets), section, letter, letter_at))
    return mentions, len(offsets)
