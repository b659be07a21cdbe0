"""Scores of pairs of items about interventions: what comes, and what would have come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.items.controls import pair_items
from dynapix.data.records import SelectionItem


@dataclass(frozen=True)
class PairScores:
    """The accuracies of a model on pairs, as fractions.

    Attributes:
        of: The intervention, or "all".
        actual, changed: Accuracy on the items about the scene's own future, and on those about the
            future that would have followed.
        both: Share of pairs with both items right: by chance 1/16, or 1/12 for a model that only
            knows that the two answers differ.
        ignored: Share of pairs whose items are both answered with the scene's own future.
    """

    of: str
    actual: Interval
    changed: Interval
    both: Interval
    ignored: Interval


def score_pairs(
    items: Sequence[SelectionItem],
    credits: Mapping[str, float],
    letters: Mapping[str, str | None],
    seed: int,
) -> list[PairScores]:
    """Return the scores of all pairs and of those of each intervention.

    Args:
        items: The items of the pairs.
        credits: The credit for each item, by its id; that of a pair is the product.
        letters: The chosen letter of each item, by its id.
        seed: Seed of the resampling of scenes.
    """
    pairs = pair_items(items)
    scenes = SceneBootstrap([actual.scene_id for actual, _ in pairs], seed)
    own = [credits[actual.item_id] for actual, _ in pairs]
    other = [credits[changed.item_id] for _, changed in pairs]
    both = [a * b for a, b in zip(own, other, strict=True)]
    ignored = [
        float({letters[actual.item_id], letters[changed.item_id]} == {actual.letter})
        for actual, changed in pairs
    ]
    measures = own, other, both, ignored
    subtypes = [actual.subtype for actual, _ in pairs]
    by_subtype = [scenes.group_means(values, subtypes) for values in measures]
    return [
        *(PairScores(of, *(means[of] for means in by_subtype)) for of in by_subtype[0]),
        PairScores("all", *(scenes.mean(values) for values in measures)),
    ]
