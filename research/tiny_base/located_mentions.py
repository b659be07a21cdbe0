"""The mentions of objects in responses: where they are in a batch, and what the oracle knows of the
objects there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from dynapix.data.records import LETTERS
from research.tiny_base.mentions import Mention, TokenizedText
from research.tiny_base.oracle_targets import PICTURES, UNKNOWN, ObjectTarget
from research.tiny_base.samples import OracleSample, shown_objects


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
