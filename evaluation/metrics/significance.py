"""How far two ways of answering the same items are apart, item by item."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from conf.errors import UserError
from data.records import FAMILIES, SelectionItem
from data.tracks.controls import pair_items
from evaluation.metrics.intervals import macro_by_scene

NAMED = 3
"""Items that are named of those that one side alone answered."""


@dataclass(frozen=True)
class PairedComparison:
    """Two ways of answering the same `n` items, called `left` and `right`; in shares.

    `of` says which items: those of a family, or all. `difference` is the left accuracy less the
    right one, with its 95% interval from `low` to `high` when whole scenes are drawn again.
    `only_left` items are right the left way alone and `only_right` the right way alone (of ties,
    those with more credit that way); `p` is McNemar's exact test of these two counts. Of "macro",
    the plain mean of the families, nothing is counted and these three are None.
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


def compare_runs(
    items: Sequence[SelectionItem],
    left: Mapping[str, float],
    right: Mapping[str, float],
    names: tuple[str, str],
    seed: int,
) -> list[PairedComparison]:
    """Hold two runs against each other on items that both answered: by family and their macro,
    where there are several, and over all.

    Args:
        left, right: the credit of each item by its id, such as whether it was answered right.
        names: what the runs are called.
        seed: of the scenes that are drawn for the intervals.

    Raises:
        UserError: one answered items that the other did not.
        KeyError: neither answered one of `items`.
    """
    check_same_items(left, right, names)
    credits = np.array([(left[i.item_id], right[i.item_id]) for i in items], float)
    families = np.array([i.family for i in items])
    scenes = np.array([i.scene_id for i in items])
    groups = {f: families == f for f in FAMILIES if f in families}
    groups = {**groups, "macro": slice(None)} if len(groups) > 1 else {}
    found = [
        _paired(names, of, credits[kept], families[kept], scenes[kept], seed)
        for of, kept in groups.items()
    ]
    together = np.full(len(items), "all")
    return [*found, _paired(names, "all", credits, together, scenes, seed)]


def compare_anchors(
    items: Sequence[SelectionItem], credits: Mapping[str, float], seed: int
) -> list[PairedComparison]:
    """Hold the two questions of matched-anchor pairs against each other, that which names the event
    (left) and that which names the time (right); `credits` is each item's by its id."""
    matched = pair_items(items)
    left = {by_event.item_id: credits[by_event.item_id] for by_event, _ in matched}
    right = {by_event.item_id: credits[by_time.item_id] for by_event, by_time in matched}
    return compare_runs([by_event for by_event, _ in matched], left, right, ("event", "time"), seed)


def check_same_items(
    left: Mapping[str, float], right: Mapping[str, float], names: tuple[str, str]
) -> None:
    """
    Raises:
        UserError: two runs did not answer the same items.
    """
    apart = (left.keys() - right.keys(), right.keys() - left.keys())
    told = [
        f"{len(ids)} only in {name} (such as {', '.join(sorted(ids)[:NAMED])})"
        for name, ids in zip(names, apart, strict=True)
        if ids
    ]
    if told:
        raise UserError(
            f"{names[0]} and {names[1]} answered different items, {' and '.join(told)}: compare "
            "runs of the same benchmark, suite, limit and seed"
        )


def _paired(
    names: tuple[str, str],
    of: str,
    credits: np.ndarray,
    families: np.ndarray,
    scenes: np.ndarray,
    seed: int,
) -> PairedComparison:
    apart = credits[:, 0] - credits[:, 1]
    means = np.mean([credits[families == f].mean(axis=0) for f in np.unique(families)], axis=0)
    found = macro_by_scene(apart, families, scenes, seed)
    told = (*map(float, means), found.value, found.low, found.high, len(credits))
    return PairedComparison(*names, of, *told, *(() if of == "macro" else _mcnemar(apart)))


def _mcnemar(apart: np.ndarray) -> tuple[int, int, float]:
    """How many differences are above 0 and how many below, and the test of these counts."""
    # Imported here: it takes longer to load than all else that a command needs for its --help.
    from statsmodels.stats.contingency_tables import mcnemar

    above, below = int((apart > 0).sum()), int((apart < 0).sum())
    return above, below, float(mcnemar([[0, above], [below, 0]], exact=True).pvalue)
