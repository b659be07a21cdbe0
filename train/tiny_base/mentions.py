"""Where a text speaks of which object, and of which picture."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
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
"""Matches where a text begins to speak of an object, a candidate or a section, and where a sentence
ends."""
AGREES = re.compile(r"[Cc]andidate (?P<letter>\w) [^.]*, and (?P<word>agrees)(?=\.)")
"""Matches the sentence of a candidate that agrees with a prediction."""
OUTCOME = re.compile(r"Candidates? (?P<letters>\w(?:, \w)*(?: and \w)?) agrees?\.")
"""Matches the sentence that names the candidates that agree."""


@dataclass(frozen=True)
class Mention:
    """A name in a text, and the tokens up to the next name or the end of the sentence.

    Attributes:
        first, last: Indices of the name's first and last token.
        stop: Index of the first token that no longer speaks of the object.
        section: Title of the section of the rationale; None before the first.
        letter: The candidate that the text speaks of; None if it speaks of the scene.
        letter_at: Index of the token of the letter, if any.
    """

    name: str
    first: int
    last: int
    stop: int
    section: str | None
    letter: str | None
    letter_at: int | None


class TokenizedText:
    """A text, and where its tokens are."""

    def __init__(self, text: str, tokenizer: PreTrainedTokenizerBase) -> None:
        self.text = text
        encoded = tokenizer(text, add_special_tokens=False, return_offsets_mapping=True)
        self._ends = [end for _, end in encoded["offset_mapping"]]

    def __len__(self) -> int:
        return len(self._ends)

    def token_at(self, character: int) -> int:
        """Return the index of the token that contains a character. A space belongs to the token of
        the next word."""
        return bisect_right(self._ends, character)

    def mentions(self) -> Iterator[Mention]:
        """Yield the names of objects in the order of the text."""
        section = letter = letter_at = None
        events = [*EVENTS.finditer(self.text)]
        starts = [*(e.start() for e in events), len(self.text)]
        for event, following in zip(events, starts[1:], strict=True):
            if name := event["name"]:
                first, last = self.token_at(event.start()), self.token_at(event.end() - 1)
                stop = self.token_at(following)
                yield Mention(name, first, last, stop, section, letter, letter_at)
            elif event["letter"]:
                letter, letter_at = event["letter"], self.token_at(event.end() - 1)
            elif event["section"]:
                section, letter, letter_at = event["section"], None, None

    def verdicts(self) -> Iterator[tuple[int, int]]:
        """Yield the index of each letter's token in an outcome, and that of the word "agrees" in
        the sentence of this candidate."""
        agreeing: dict[str, int] = {}
        events = sorted(
            [*AGREES.finditer(self.text), *OUTCOME.finditer(self.text)], key=lambda e: e.start()
        )
        for event in events:
            if event.re is AGREES:
                agreeing[event["letter"]] = self.token_at(event.start("word"))
                continue
            for letter in re.finditer(r"[A-Z]", event["letters"]):
                at = event.start("letters") + letter.start()
                yield self.token_at(at), agreeing[letter.group()]
            agreeing.clear()
