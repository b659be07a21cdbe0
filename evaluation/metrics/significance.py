"""Paired comparison of the accuracies of two runs on the same items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.errors import UserError
from data.records import FAMILIES, SelectionItem
from data.tracks.controls import pair_items
from evaluation.metrics.intervals import macro_by_scene

MAX_NAMED_ITEMS = 3
"""Most items of each run that the error about different items names."""


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
        p: p-value of McNemar's exact test of these two numbers. None for "macro".
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
    only_left: int | None = None
    only_right: int | None = None
    p: float | None = None
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
        seed: Seed of the bootstrap over scenes.

    Raises:
        UserError: The runs answered different items.
        KeyError: Both runs lack one of `items`.
    """
    check_same_items(left, right, names)
    credits = np.array([(left[i.item_id], right[i.item_id]) for i in items], float)
    families = np.array([i.family for i in items])
    scenes = np.array([i.scene_id for i in items])
    masks = {f: families == f for f in FAMILIES if f in families}
    masks = {**masks, "macro": slice(None)} if len(masks) > 1 else {}
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
    mean = macro_by_scene(differences, families, scenes, seed)
    counts = () if of == "macro" else _mcnemar(differences)
    return PairedComparison(
        *names, of, *map(float, means), mean.value, mean.low, mean.high, len(credits), *counts
    )


def _mcnemar(differences: np.ndarray) -> tuple[int, int, float]:
    """Return the numbers of positive and of negative differences, and the p-value of their test."""
    # statsmodels takes longer to import than everything else that --help needs.
    from statsmodels.stats.contingency_tables import mcnemar

    positive, negative = int((differences > 0).sum()), int((differences < 0).sum())
    return positive, negative, float(mcnemar([[0, positive], [negative, 0]], exact=True).pvalue)
