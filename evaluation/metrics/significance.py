"""Paired comparison of the accuracies of two runs on the same items, and scores of pairs of items
about interventions: what comes, and what would have come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.items.controls import pair_items
from dynapix.data.records import FAMILIES, SelectionItem
from dynapix.evaluation.metrics.seeds import MACRO

MAX_NAMED_ITEMS = 3
"""Most items of each run that the error about different items names."""
EXACT_SCENES = 12
"""Largest number of scenes for which a sign-flip test enumerates all outcomes."""
FLIPS = 10_000
"""Random outcomes of a sign-flip test with more than `EXACT_SCENES` scenes."""
TINY = 1e-9
"""Differences of sums up to this size are rounding errors."""


@dataclass(frozen=True)
class PairedComparison:
    """The accuracies of two runs, named `left` and `right`, on the same `n` items, as fractions.

    Attributes:
        of: What the accuracies are of: a family, "all" items, or "macro", the unweighted mean of
            the families' accuracies.
        difference: Left accuracy minus right accuracy.
        low, high: 95% interval of the difference, bootstrapped over scenes.
        only_left, only_right: Numbers of items for which only this run is correct. An item with
            tied candidates counts for the run with more credit. None for "macro".
        p: p-value of the sign-flip test over scenes (see `sign_flip_test`).
        mcnemar: p-value of McNemar's exact test of `only_left` and `only_right`, which treats the
            items of a scene as independent. None for "macro".
        mode: Mode of both runs; empty if their names contain it.
    """

    left: str
    right: str
    of: str
    left_accuracy: float
    right_accuracy: float
    difference: float
    low: float
    high: float
    n: int
    p: float
    only_left: int | None = None
    only_right: int | None = None
    mcnemar: float | None = None
    mode: str = ""


def compare_runs(
    items: Sequence[SelectionItem],
    left: Mapping[str, float],
    right: Mapping[str, float],
    names: tuple[str, str],
    seed: int,
) -> list[PairedComparison]:
    """Compare two runs over all items, and by family and macro if there are several families.

    Args:
        left, right: The credit for each item (1 for a correct choice) by item id.
        names: The names of the left and of the right run.
        seed: Seed of the resampling of scenes.

    Raises:
        UserError: The runs answered different items.
        KeyError: Both runs lack one of `items`.
    """
    check_same_items(left, right, names)
    credits = np.array([(left[i.item_id], right[i.item_id]) for i in items], float)
    families = np.array([i.family for i in items])
    scenes = np.array([i.scene_id for i in items])
    masks = {f: families == f for f in FAMILIES if f in families}
    masks = {**masks, MACRO: slice(None)} if len(masks) > 1 else {}
    compared = [
        _compare(names, of, credits[mask], families[mask], scenes[mask], seed)
        for of, mask in masks.items()
    ]
    one_group = np.full(len(items), "all")
    return [*compared, _compare(names, "all", credits, one_group, scenes, seed)]


def compare_anchors(
    items: Sequence[SelectionItem], credits: Mapping[str, float], seed: int
) -> list[PairedComparison]:
    """Compare the event question (left) with the time question (right) of matched-anchor pairs.

    `credits` has the credit for each item by its id.
    """
    pairs = pair_items(items)
    left = {by_event.item_id: credits[by_event.item_id] for by_event, _ in pairs}
    right = {by_event.item_id: credits[by_time.item_id] for by_event, by_time in pairs}
    return compare_runs([by_event for by_event, _ in pairs], left, right, ("event", "time"), seed)


def check_same_items(
    left: Mapping[str, Any], right: Mapping[str, Any], names: tuple[str, str]
) -> None:
    """Raise a UserError if two runs, whose results are given by item id, answered other items."""
    unshared = (left.keys() - right.keys(), right.keys() - left.keys())
    differences = [
        f"{len(ids)} only in {name} (such as {', '.join(sorted(ids)[:MAX_NAMED_ITEMS])})"
        for name, ids in zip(names, unshared, strict=True)
        if ids
    ]
    if differences:
        raise UserError(
            f"{names[0]} and {names[1]} answered different items ({' and '.join(differences)}): "
            "compare runs of the same benchmark, suite, limit and seed",
            code="different-items",
        )


def sign_flip_test(
    differences: np.ndarray, groups: np.ndarray, scenes: np.ndarray, seed: int
) -> float:
    """Return the two-sided p-value of a mean difference under random flips of the scenes' signs.

    If two runs are equally good, exchanging them for all items of a scene gives an equally likely
    outcome. The p-value is the share of outcomes whose mean is at least as far from 0 as the
    observed one. Up to `EXACT_SCENES` scenes, all outcomes are enumerated; for more scenes, `FLIPS`
    random ones and the observed one are used.

    Args:
        differences: (items,) left credit minus right credit.
        groups: (items,) the family of each item; the mean is the unweighted mean of their means.
        scenes: (items,) the scene of each item.
    """
    _, group_of, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    _, scene_of = np.unique(scenes, return_inverse=True)
    parts = np.bincount(scene_of, differences / sizes[group_of]) / len(sizes)
    parts = parts[np.abs(parts) > TINY]
    if len(parts) <= EXACT_SCENES:
        outcomes = np.zeros(1)
        for part in parts:
            outcomes = np.concatenate([outcomes + part, outcomes - part])
    else:
        rng = np.random.default_rng(seed)
        signs = rng.choice(np.array([-1, 1], np.int8), (FLIPS, len(parts)))
        outcomes = np.concatenate([signs @ parts, [parts.sum()]])
    return float(np.mean(np.abs(outcomes) >= abs(parts.sum()) - TINY))


def mcnemar_test(only_left: int, only_right: int) -> float:
    """Return the p-value of McNemar's exact test: the two-sided binomial test of two counts."""
    n, smaller = only_left + only_right, min(only_left, only_right)
    tail = sum(comb(n, k) for k in range(smaller + 1))
    return min(1.0, 2 * tail / 2**n)


def adjust_holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for the number of tests by Holm's step-down method."""
    values = np.asarray(p_values, float)
    order = np.argsort(values, kind="stable")
    factors = len(values) - np.arange(len(values))
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * values[order]), 1)
    return adjusted.tolist()


def _compare(
    names: tuple[str, str],
    of: str,
    credits: np.ndarray,
    families: np.ndarray,
    scenes: np.ndarray,
    seed: int,
) -> PairedComparison:
    differences = credits[:, 0] - credits[:, 1]
    means = np.mean([credits[families == f].mean(axis=0) for f in np.unique(families)], axis=0)
    mean = SceneBootstrap(scenes, seed).macro(differences, families)
    p = sign_flip_test(differences, families, scenes, seed)
    counts: tuple = ()
    if of != MACRO:
        better = int((differences > 0).sum()), int((differences < 0).sum())
        counts = (*better, mcnemar_test(*better))
    return PairedComparison(
        *names, of, *map(float, means), mean.value, mean.low, mean.high, len(credits), p, *counts
    )


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
