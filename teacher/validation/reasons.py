"""What a student's response claims, and whether its answer follows from true reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.sections import split_sections
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.sufficiency import measure_sufficiency

PARTS = ("prefix", "prediction", "candidates")
"""What claims are about: the observed prefix, what follows it, or the candidates."""
SUPPORTED, CONTRADICTED = "supported", "contradicted"
NOWHERE = (0, 0)
"""Span of a section that a text lacks."""


@dataclass(frozen=True)
class ResponseReasons:
    """The reasons of one response.

    Attributes:
        claims: The claims about each of `PARTS`, with the verdicts of the oracle. A mention of an
            existing object is not counted. A mention of an object that the scene lacks is counted
            as a contradicted claim.
        follows: Whether the text says of the chosen candidate, and of no other, that it agrees.
        sufficiency: Probability that a reader who knows only the prediction picks the target (see
            `teacher.validation.sufficiency`).
        true: Whether the answer is right for true reasons: it is the target, it follows, the oracle
            supports a claim of the prediction, and it contradicts no claim about what follows or
            about the candidates.
    """

    claims: dict[str, tuple[Claim, ...]]
    follows: bool
    sufficiency: float
    true: bool


def read_response(
    text: str, letter: str | None, target: str, predicates: RelationalPredicates
) -> ResponseReasons:
    """Read the reasons of a response to an item.

    Args:
        letter: The chosen letter, if any.
        target: The letter of the target.
    """
    claims = extract_claims(text, predicates)
    sections = split_sections(text)
    spans = {name: (start, stop) for name, start, stop in sections}
    by_part = _divide(claims, spans.get("Scene parse", NOWHERE))
    answers = [(start, stop) for name, start, stop in sections if name == "Answer"]
    agreeing = [
        c
        for c in claims
        if c.kind == "agrees" and not any(start <= c.span[0] < stop for start, stop in answers)
    ]
    affirmed = {c.candidate for c in agreeing if c.affirmed}
    denied = {c.candidate for c in agreeing if not c.affirmed}
    follows = letter is not None and affirmed == {letter} and letter not in denied
    later = [*by_part["prediction"], *by_part["candidates"]]
    rests = any(c.verdict == SUPPORTED for c in by_part["prediction"])
    false = any(c.verdict == CONTRADICTED for c in later)
    true = letter == target and follows and rests and not false
    return ResponseReasons(by_part, follows, measure_sufficiency(text, claims, predicates), true)


def _divide(claims: Sequence[Claim], scene_parse: tuple[int, int]) -> dict[str, tuple[Claim, ...]]:
    """Return the claims about each part, in text order.

    Args:
        scene_parse: Span of the section that describes the prefix.
    """
    start, stop = scene_parse
    parts: dict[str, list[Claim]] = {part: [] for part in PARTS}
    for claim in claims:
        if claim.kind == "agrees" or (claim.kind == "mention" and claim.verdict != CONTRADICTED):
            continue
        part = "prefix" if start <= claim.span[0] < stop else "prediction"
        parts["candidates" if claim.candidate is not None else part].append(claim)
    return {part: tuple(found) for part, found in parts.items()}
