"""Where a text describes which object, and in which picture."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass

from transformers import PreTrainedTokenizerBase

from dynapix.data.records import COLORS, LETTERS, MATERIALS, SHAPES
from dynapix.teacher.sections import SECTIONS

NAME = re.compile(" ".join(f"(?:{'|'.join(words)})" for words in (COLORS, MATERIALS, SHAPES)))
"""Matches the noun phrase of an object."""
EVENTS = re.compile(
    rf"Supposition: candidate (?P<supposed>[{''.join(LETTERS)}])\b"
    rf"|(?P<name>{NAME.pattern})|[Cc]andidate (?P<letter>[{''.join(LETTERS)}])\b"
    rf"|(?P<section>{'|'.join(SECTIONS)}):|(?P<end>\.(?=\s|$))"
)
"""Matches where a text supposes that a candidate is the target, where it begins to describe an
object, a candidate or a section, and where a sentence ends."""
AGREES = re.compile(
    r"[Cc]andidate (?P<letter>\w) [^.]*,? and (?P<word>agrees)(?=\.| with the prediction\.)"
)
"""Matches the sentence of a candidate that agrees with a prediction."""
OUTCOME = re.compile(
    r"(?:[Cc]andidates?|Answer:) (?P<letters>\w(?:, \w)*(?: and \w)?)"
    r"(?= agrees?\.| shows this layout\.|\.|$)",
    re.MULTILINE,
)
"""Matches where a text names the candidates that agree."""
CLOSEST = re.compile(
    rf"[Tt]he (?P<name>{NAME.pattern}) is closest to its expected place in candidate (?P<letter>\w)"
)
"""Matches where a text names the candidate that shows an object closest to its place."""
MATCH = re.compile(r"^Candidate (?P<letter>\w) (?:matches|does not match)", re.MULTILINE)
"""Matches where a line says whether a candidate matches the prediction."""
REFERENCE = re.compile(r"\b(?:with|has|have) the $")
"""Matches the words before the sphere in "the cube has the sphere left of it"."""
PREDICTION = re.compile("Prediction:")


@dataclass(frozen=True)
class Mention:
    """A name in a text, and the tokens up to the next name, candidate or section, or the end of the
    sentence.

    Attributes:
        first, last: Indices of the name's first and last token.
        stop: Index of the first token that no longer describes the object.
        section: Title of the section of the rationale; None before the first.
        letter: The candidate that the text describes; None if it describes the scene.
        letter_at: Index of the token of the letter, if any.
        supposed: The candidate that the text supposes to be the target, if any.
        reference: Index of the mention of the reference object if the text gives this object's
            place relative to it, as to the cube in "the cube has the sphere left of it"; otherwise
            None.
    """

    name: str
    first: int
    last: int
    stop: int
    section: str | None
    letter: str | None
    letter_at: int | None
    supposed: str | None
    reference: int | None


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
        section = letter = letter_at = supposed = previous = None
        end = count = 0
        events = [*EVENTS.finditer(self.text)]
        starts = [*(e.start() for e in events), len(self.text)]
        for event, following in zip(events, starts[1:], strict=True):
            if name := event["name"]:
                reference = None
                if previous and REFERENCE.search(self.text[end : event.start()]):
                    # "The cube with the sphere left of it and with the cylinder near it": the cube.
                    reference = count - 1 if previous.reference is None else previous.reference
                first, last = self.token_at(event.start()), self.token_at(event.end() - 1)
                stop = self.token_at(following)
                where = section, letter, letter_at, supposed
                previous = Mention(name, first, last, stop, *where, reference)
                end, count = event.end(), count + 1
                yield previous
            elif event["supposed"]:
                supposed = event["supposed"]
            elif event["letter"]:
                letter, letter_at = event["letter"], self.token_at(event.end() - 1)
            elif event["section"]:
                section, letter, letter_at = event["section"], None, None
            else:
                previous = None

    def verdicts(self) -> Iterator[tuple[int, int]]:
        """Yield the index of each letter's token in an outcome or answer, and that of the word
        "agrees" in the sentence of this candidate, or of its letter after "closest"."""
        agreeing: dict[str, int] = {}
        for event in self._find(PREDICTION, AGREES, CLOSEST, OUTCOME):
            if event.re is PREDICTION:
                agreeing.clear()
            elif event.re in (AGREES, CLOSEST):
                word = "word" if event.re is AGREES else "letter"
                agreeing[event["letter"]] = self.token_at(event.start(word))
            else:
                for letter in re.finditer(r"[A-Z]", event["letters"]):
                    at = self.token_at(event.start("letters") + letter.start())
                    # The letter after "closest" may itself end a sentence.
                    if agreeing.get(letter.group(), at) < at:
                        yield at, agreeing[letter.group()]

    def choices(self) -> Iterator[tuple[int, int]]:
        """Yield the index of the token of each letter after "closest", and that of the last token
        at which the text describes the object in this candidate."""
        described: dict[tuple[str, str], int] = {}
        mentions = [m for m in self.mentions() if m.section == "Candidate analysis" and m.letter]
        for event in CLOSEST.finditer(self.text):
            start = self.token_at(event.start())
            described |= {(m.letter, m.name): m.stop - 1 for m in mentions if m.first < start}
            if (key := described.get((event["letter"], event["name"]))) is not None:
                yield self.token_at(event.start("letter")), key

    def matches(self) -> Iterator[tuple[int, int]]:
        """Yield the index of the token of the letter in each line that says whether a candidate
        matches, and that of the last letter before these lines, in the outcome."""
        outcome = None
        for event in self._find(OUTCOME, MATCH):
            if event.re is OUTCOME:
                outcome = self.token_at(event.end("letters") - 1)
            elif outcome is not None:
                yield self.token_at(event.start("letter")), outcome

    def _find(self, *patterns: re.Pattern[str]) -> list[re.Match[str]]:
        """Return the matches of all patterns in the order of the text."""
        found = [m for pattern in patterns for m in pattern.finditer(self.text)]
        return sorted(found, key=lambda m: m.start())
