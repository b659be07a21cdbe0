"""What a student's rationales claim, and whether its answers rest on true reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from data.records import SelectionItem
from evaluation.metrics.intervals import Interval, SceneBootstrap
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.relations import Bounds
from teacher.reading.grounding import Claim
from teacher.sections import split_sections
from teacher.sufficiency import measure_sufficiency
from teacher.validation.claim_extraction import extract_claims

if TYPE_CHECKING:
    from data.store import Store
    from evaluation.generators.response_log import Answer

PARTS = ("prefix", "prediction", "candidates")
"""What claims are about: the observed prefix, what follows it, or the candidates."""
SUPPORTED, CONTRADICTED = "supported", "contradicted"
NOWHERE = (0, 0)
"""Span of a section that a text lacks."""


@dataclass(frozen=True)
class ResponseReasons:
    """The reasons of one response.

    Attributes:
        claims: The claims about each of `PARTS`, with the verdicts of the oracle. That an object
            exists is no claim, but a statement about an object that the scene lacks is one, which
            the oracle contradicts.
        follows: Whether the text says of the chosen candidate, and of no other, that it agrees.
        sufficiency: Probability that a reader who knows only the prediction picks the target (see
            `teacher.sufficiency`).
        true: Whether the answer is right for true reasons: it is the target, it follows, the oracle
            supports a claim of the prediction, and it contradicts no claim about what follows or
            about the candidates.
    """

    claims: dict[str, tuple[Claim, ...]]
    follows: bool
    sufficiency: float
    true: bool


@dataclass(frozen=True)
class PartSummary:
    """Claims about one part: their mean number in a response, and the shares of them that the
    oracle supports and contradicts; these are None if no response has such a claim."""

    claims: Interval
    supported: Interval | None
    contradicted: Interval | None


@dataclass(frozen=True)
class ReasonSummary:
    """The reasons of all responses to items that have predicates.

    Attributes:
        parts: By part, see `PARTS`.
        follows, true, sufficiency: Means of the fields of `ResponseReasons`.
    """

    parts: dict[str, PartSummary]
    follows: Interval
    true: Interval
    sufficiency: Interval


def measure_reasons(
    items: Sequence[SelectionItem], answers: Sequence[Answer], store: Store, seed: int
) -> ReasonSummary | None:
    """Summarize the reasons of the responses to items; None if no item has predicates.

    Args:
        seed: Seed of the bootstrap over scenes.
    """
    read = [read_reasons(i, a.text, a.letter, store) for i, a in zip(items, answers, strict=True)]
    found = [(item, r) for item, r in zip(items, read, strict=True) if r is not None]
    if not found:
        return None
    scenes = SceneBootstrap([item.scene_id for item, _ in found], seed)
    reasons = [r for _, r in found]
    return ReasonSummary(
        {part: _summarize_part([r.claims[part] for r in reasons], scenes) for part in PARTS},
        scenes.mean([r.follows for r in reasons]),
        scenes.mean([r.true for r in reasons]),
        scenes.mean([r.sufficiency for r in reasons]),
    )


def read_reasons(
    item: SelectionItem, text: str, letter: str | None, store: Store
) -> ResponseReasons | None:
    """Read the reasons of a response; None if the item has no predicates, because a collision
    follows its prefix too early."""
    scene = store.scene(item.scene_id)
    predicates = extract_predicates(item, scene, store.scene, Bounds())
    if predicates is None:
        return None
    claims = extract_claims(text, predicates)
    spans = {name: (start, stop) for name, start, stop in split_sections(text)}
    by_part = _divide(claims, spans.get("Scene parse", NOWHERE))
    first, last = spans.get("Answer", NOWHERE)
    agreeing = [c for c in claims if c.kind == "agrees" and not first <= c.span[0] < last]
    affirmed = {c.candidate for c in agreeing if c.affirmed}
    denied = {c.candidate for c in agreeing if not c.affirmed}
    follows = letter is not None and affirmed == {letter} and letter not in denied
    later = [*by_part["prediction"], *by_part["candidates"]]
    rests = any(c.verdict == SUPPORTED for c in by_part["prediction"])
    false = any(c.verdict == CONTRADICTED for c in later)
    true = letter == item.letter and follows and rests and not false
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


def _summarize_part(claims: Sequence[Sequence[Claim]], scenes: SceneBootstrap) -> PartSummary:
    total = np.array([len(found) for found in claims], float)
    shares = [
        scenes.ratio([sum(c.verdict == verdict for c in found) for found in claims], total)
        if total.any()
        else None
        for verdict in (SUPPORTED, CONTRADICTED)
    ]
    return PartSummary(scenes.mean(total), *shares)
