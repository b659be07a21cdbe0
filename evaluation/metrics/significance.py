"""Paired comparison of two runs over the same items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from conf.errors import UserError
from data.records import FAMILIES, SelectionItem
from data.tracks.controls import pair_items
from evaluation.metrics.intervals import macro_by_scene

NAMED = 3
"""Number of items that the error about different items names."""


@dataclass(frozen=True)
class PairedComparison:
    """Two runs over the same `n` items, called `left` and `right`; all numbers are shares.

    Attributes:
        of: The items: a family's, "macro" for the plain mean of the families, or "all".
        mode: Mode of both runs, if only one is compared.
        difference: Left accuracy less right accuracy, with its 95% interval from `low` to `high`
            by resampling scenes.
        only_left, only_right: Items that are right on one side only (of ties, those with more
            credit on that side). None for "macro".
        p: McNemar's exact test of these two counts. None for "macro".
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
    """Compare two runs by family and macro, if there are several families, and over all items.

    Args:
        left, right: The credit of each item by its id, such as whether it was answered right.
        names: What the runs are called.
        seed: Seed of the scene resampling for the intervals.

    Raises:
        UserError: The runs answered different items.
        KeyError: Neither answered one of `items`.
    """
    check_same_items(left, right, names)
    credits = np.array([(left[i.item_id], right[i.item_id]) for i in items], float)
    families = np.array([i.family for i in items])
    scenes = np.array([i.scene_id for i in items])
    groups = {f: families == f for f in FAMILIES if f in families}
    groups = {**groups, "macro": slice(None)} if len(groups) > 1 else {}
    compared = [
        _compare(names, of, credits[kept], families[kept], scenes[kept], seed)
        for of, kept in groups.items()
    ]
    together = np.full(len(items), "all")
    return [*compared, _compare(names, "all", credits, together, scenes, seed)]


def compare_anchors(
    items: Sequence[SelectionItem], credits: Mapping[str, float], seed: int
) -> list[PairedComparison]:
    """Compare the questions of matched-anchor pairs: event (left) with time (right).

    `credits` has each item's credit by its id.
    """
    matched = pair_items(items)
    left = {by_event.item_id: credits[by_event.item_id] for by_event, _ in matched}
    right = {by_event.item_id: credits[by_time.item_id] for by_event, by_time in matched}
    return compare_runs([by_event for by_event, _ in matched], left, right, ("event", "time"), seed)


def check_same_items(
    left: Mapping[str, Any], right: Mapping[str, Any], names: tuple[str, str]
) -> None:
    """Raise a UserError if two runs, each with its results by item id, answered different items."""
    extra = (left.keys() - right.keys(), right.keys() - left.keys())
    differences = [
        f"{len(ids)} only in {name} (such as {', '.join(sorted(ids)[:NAMED])})"
        for name, ids in zip(names, extra, strict=True)
        if ids
    ]
    if differences:
        raise UserError(
            f"{names[0]} and {names[1]} answered different items, {' and '.join(differences)}: "
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
    """Return the numbers of positive and negative differences, and the test of these counts."""
    # statsmodels takes longer to import than everything else that --help needs.
    from statsmodels.stats.contingency_tables import mcnemar

    above, below = int((differences > 0).sum()), int((differences < 0).sum())
    return above, below, float(mcnemar([[0, above], [below, 0]], exact=True).pvalue)
