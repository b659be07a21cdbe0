"""What the rationales of a student claim, and how often its answers rest on true reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dynapix.conf.schema import TeacherConfig
from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.records import SelectionItem
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.validation.reasons import (
    CONTRADICTED,
    PARTS,
    SUPPORTED,
    ResponseReasons,
    read_response,
)

if TYPE_CHECKING:
    from dynapix.data.store import Store
    from dynapix.evaluation.generators.response_log import Answer


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
    """Read the reasons of a response; None if the item has no predicates, because its prefix is
    too short."""
    predicates = item_predicates(item, store)
    return None if predicates is None else read_response(text, letter, item.letter, predicates)


def item_predicates(item: SelectionItem, store: Store) -> RelationalPredicates | None:
    """Return all predicates of an item, with which claims are compared; None if the item has no
    predicates, because its prefix is too short."""
    return describe_item(item, store, TeacherConfig())


def _summarize_part(claims: Sequence[Sequence[Claim]], scenes: SceneBootstrap) -> PartSummary:
    total = np.array([len(found) for found in claims], float)
    shares = [
        scenes.ratio([sum(c.verdict == verdict for c in found) for found in claims], total)
        if total.any()
        else None
        for verdict in (SUPPORTED, CONTRADICTED)
    ]
    return PartSummary(scenes.mean(total), *shares)
