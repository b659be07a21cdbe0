"""The mentions of objects in texts: where a text describes which object, in which
picture, and where in a batch, and what the oracle knows of the objects there."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from transformers import PreTrainedTokenizerBase

from dynapix.data.records import COLORS, LETTERS, MATERIALS, SHAPES
from dynapix.teacher.sections import SECTIONS
from research.tiny_base.oracle_targets import PICTURES, UNKNOWN, ObjectTarget
from research.tiny_base.samples import OracleSample, shown_objects

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


@dataclass(frozen=True)
class LocatedMention:
    """A mention of an object, with the oracle's targets. Positions are those of the batch.

    Attributes:
        row, first, position: Row of the batch, and positions of the name's first and last token.
        described: Positions of the tokens that describe the object, from the name's last token on.
        section: Title of the section of the rationale; None before the first.
        state: Place (from -0.5 to 0.5) and velocity of the object in the picture that the text
            describes; NaN where the oracle does not determine them.
        letter_at: Position of the letter of the candidate that the text describes, if any.
        picture: Index of the picture that the text describes: 0 for the last one of the clip, 1 to
            4 for the candidates.
        found: Visual token of the object in each of `PICTURES`, or -1.
        places: The object's places in these pictures, NaN where it is not visible.
        future: Its displacement to the moment of the target, or NaN.
        reference: Position of the name of the reference object if the text gives this object's
            place relative to it, as to the cube in "the cube has the sphere left of it"; otherwise
            None.
        offset: The displacement from the reference object to this object in the picture that the
            text describes, or NaN.
        error: If the text describes a candidate, the displacement of the object there from its
            expected place, otherwise NaN.
    """

    name: str
    row: int
    first: int
    position: int
    described: range
    section: str | None
    state: tuple[float, ...]
    letter_at: int | None
    picture: int
    found: tuple[int, ...]
    places: tuple[float, ...]
    future: tuple[float, float]
    reference: int | None
    offset: tuple[float, float]
    error: tuple[float, float]


def locate_mentions(
    sample: OracleSample, text: TokenizedText, row: int, start: int, grid: int
) -> Iterator[LocatedMention]:
    """Yield the mentions of objects in a sample's response, whose first token is at `start`."""
    shown = shown_objects(sample)
    mentions = [*text.mentions()]
    states = [described_state(sample, shown, m) for m in mentions]
    for m, state in zip(mentions, states, strict=True):
        reference = None if m.reference is None else start + mentions[m.reference].last
        offset = UNKNOWN
        if m.reference is not None:
            offset = state[0] - states[m.reference][0], state[1] - states[m.reference][1]
        pictures = [shown.get((sample.last + k, m.name)) for k in range(PICTURES)]
        yield LocatedMention(
            m.name,
            row,
            start + m.first,
            start + m.last,
            range(start + m.last, start + m.stop),
            m.section,
            state,
            None if m.letter_at is None else start + m.letter_at,
            0 if m.letter is None else 1 + LETTERS.index(m.letter),
            tuple(t.token(grid) if t else -1 for t in pictures),
            tuple(x for t in pictures for x in (t.place if t else UNKNOWN)),
            sample.future.get(m.name, UNKNOWN),
            reference,
            offset,
            measure_error(sample, shown, m),
        )


def find_repeats(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before a name that the text has mentioned before, and the
    position of the first token of its last mention."""
    mentioned: dict[tuple[int, str], int] = {}
    for m in mentions:
        if (m.row, m.name) in mentioned:
            yield m.row, m.first - 1, mentioned[m.row, m.name]
        mentioned[m.row, m.name] = m.first


def find_next_in_clip(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before the first mention of an object in a scene parse, and the
    object's visual token at the end of the clip."""
    mentioned = set()
    for m in mentions:
        if m.section == "Scene parse" and (m.row, m.name) not in mentioned and m.found[0] >= 0:
            yield m.row, m.first - 1, m.found[0]
        mentioned.add((m.row, m.name))


def find_next_in_candidates(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before the first mention of an object in a text and in its
    predictions, and the object's visual token in the last candidate that shows it."""
    mentioned = set()
    for m in mentions:
        shown = [token for token in m.found[1:] if token >= 0]
        key = m.row, m.name, m.section == "Prediction"
        if key not in mentioned and shown:
            yield m.row, m.first - 1, shown[-1]
        mentioned.add(key)


def measure_error(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], mention: Mention
) -> tuple[float, float]:
    """Return the displacement of a named object in the candidate that the text describes from its
    place in the supposed target or, if none is supposed, at the target; NaN where the oracle does
    not determine it."""
    if mention.letter is None:
        return UNKNOWN
    there = shown.get((sample.last + 1 + LETTERS.index(mention.letter), mention.name))
    if mention.supposed is not None:
        place = sample.last + 1 + LETTERS.index(mention.supposed), mention.name
        expected = shown[place].place if place in shown else UNKNOWN
    else:
        expected = predicted_place(sample, shown, mention.name)
    if there is None:
        return UNKNOWN
    return there.place[0] - expected[0], there.place[1] - expected[1]


def predicted_place(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], name: str
) -> tuple[float, float]:
    """Return the place of an object at the target, if the response predicts it; NaN if it does not
    or if the object is not visible at the end of the clip or at the target."""
    now, moved = shown.get((sample.last, name)), sample.future.get(name)
    if now is None or moved is None or not sample.predicts_target:
        return UNKNOWN
    return now.place[0] + moved[0], now.place[1] + moved[1]


def described_state(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], mention: Mention
) -> tuple[float, ...]:
    """Return the place (from -0.5 to 0.5) and the velocity of a named object in the picture that
    the text describes there; NaN where the oracle does not determine them."""
    place, velocity = UNKNOWN, UNKNOWN
    if mention.letter is not None:
        seen = shown.get((sample.last + 1 + LETTERS.index(mention.letter), mention.name))
        place = seen.place if seen else UNKNOWN
    elif mention.section in ("Prediction", "Outcome"):
        place = predicted_place(sample, shown, mention.name)
    elif mention.name in sample.observed:
        state = sample.observed[mention.name]
        place, velocity = state[:2], state[2:]
    return place[0] - 0.5, place[1] - 0.5, *velocity
