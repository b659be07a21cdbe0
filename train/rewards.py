"""Rewards of a student's responses: what the oracle supports, and what the form requires.

Each reward is a function of a `JudgedResponse`. A reward cannot be raised by empty text: a response
that repeats itself, copies the question, states nothing that the oracle can check, or names all
letters earns no more than the answer line alone.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

from dynapix.data.records import SelectionItem
from dynapix.models.student.answer_parser import parse_choice
from dynapix.teacher.numbers.detection import find_numbers
from dynapix.teacher.predicates.facts import Relation, RelationalPredicates
from dynapix.teacher.predicates.relations import VALUES, normalize_relation
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.sections import SECTIONS, split_sections
from dynapix.teacher.validation.reasons import (
    CONTRADICTED,
    SUPPORTED,
    ResponseReasons,
    read_response,
)

MIN_CLAIMS = 6
"""Minimum denominator of `reward_truth`: a response with fewer different claims earns less."""
MAX_MENTIONS = 10
"""A claim that a response states more often than this counts as contradicted each further time. In
the narrator's responses, the analysis and the match layout repeat what is predicted for each false
candidate ("not near the top")."""


@dataclass(frozen=True)
class JudgedResponse:
    """A response to an item, as the oracle judges it.

    Attributes:
        letter: The chosen letter, if any.
        target: The letter of the target.
        truncated: Whether the response was cut off at the token limit.
    """

    text: str
    letter: str | None
    target: str
    reasons: ResponseReasons
    truncated: bool


def judge_response(
    text: str, truncated: bool, item: SelectionItem, predicates: RelationalPredicates
) -> JudgedResponse:
    """Return a response with its answer and its claims.

    Args:
        predicates: All predicates of the item.
    """
    letter = parse_choice(text, truncated=truncated).letter
    reasons = read_response(text, letter, item.letter, predicates)
    return JudgedResponse(text, letter, item.letter, reasons, truncated)


def reward_answer(response: JudgedResponse) -> float:
    """Return 1 for the target's letter, otherwise 0."""
    return float(response.letter == response.target)


def reward_truth(response: JudgedResponse) -> float:
    """Return the share of the claims that the oracle supports less that of those it contradicts,
    from -1 to 1: the sum over `credit_claims`."""
    return math.fsum(credit for _, credit in credit_claims(response))


def credit_claims(response: JudgedResponse) -> list[tuple[Claim, float]]:
    """Return the claims that the oracle supports or contradicts, each with its part of
    `reward_truth`.

    Each claim counts once, whatever its moment and the order of its objects: its mentions share its
    part. Further mentions above `MAX_MENTIONS` count as contradicted. Negated claims count only if
    they are contradicted: otherwise, a list of what is not the case would be supported without any
    knowledge. A claim that is contradicted at one moment is not supported at another.
    """
    mentions: dict[tuple, list[Claim]] = defaultdict(list)
    for claims in response.reasons.claims.values():
        for claim in claims:
            mentions[_identify(claim)].append(claim)
    credits: list[tuple[Claim, float]] = []
    counted = 0
    for claims in mentions.values():
        contradicted = [claim for claim in claims if claim.verdict == CONTRADICTED]
        earned = contradicted or [claim for claim in claims if _is_earned(claim)]
        sign = -1 if contradicted else 1
        credits += [(claim, sign / len(earned)) for claim in earned]
        repeated = claims[MAX_MENTIONS:]
        credits += [(claim, -1) for claim in repeated]
        counted += bool(contradicted or claims[0].affirmed) + len(repeated)
    total = max(counted, MIN_CLAIMS)
    return [(claim, credit / total) for claim, credit in credits]


def _identify(claim: Claim) -> tuple:
    subjects, value = claim.subjects, claim.value
    if claim.kind in VALUES and len(subjects) > 1:
        _, subjects, value = normalize_relation(Relation(claim.kind, subjects, value))
    return claim.kind, subjects, value, claim.affirmed, claim.candidate


def _is_earned(claim: Claim) -> bool:
    return claim.verdict == SUPPORTED and claim.affirmed


def reward_following(response: JudgedResponse) -> float:
    """Return 1 if the answer follows from the text, `reward_truth` is positive, and the oracle
    supports a claim of its prediction; otherwise 0."""
    predicted = any(map(_is_earned, response.reasons.claims["prediction"]))
    return float(response.reasons.follows and predicted and reward_truth(response) > 0)


def reward_no_numbers(response: JudgedResponse) -> float:
    """Return -1 for a text with numbers, otherwise 0."""
    return -float(bool([*find_numbers(response.text)]))


def reward_form(response: JudgedResponse) -> float:
    """Return -1 for a response that was cut off, or whose sections and answer are out of order or
    occur twice, otherwise 0. Without sections, only the cut counts."""
    headings = [name for name, _, _ in split_sections(response.text)]
    in_order = headings == [name for name in (*SECTIONS, "Answer") if name in headings]
    return -float(response.truncated or not in_order)


REWARDS: dict[str, Callable[[JudgedResponse], float]] = {
    "answer": reward_answer,
    "truth": reward_truth,
    "following": reward_following,
    "no_numbers": reward_no_numbers,
    "form": reward_form,
}
"""The rewards by the names of their weights."""
