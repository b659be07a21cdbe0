"""Accuracy by family and by other groups of items, as shares between 0 and 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import FAMILIES
from evaluation.metrics.intervals import Interval, wilson_interval


@dataclass(frozen=True)
class Accuracy:
    """Accuracy by family, in the order event, time, window; a family without items is left out."""

    families: dict[str, Interval]
    macro: float
    micro: Interval


def accuracy_by_group(groups: Sequence[str], correct: Sequence[float]) -> dict[str, Interval]:
    """Accuracy of each group of items, in order of name.

    Args:
        groups: a name an item: its family, subtype or horizon.
        correct: its credit, a bool or the 1/m of a tie among m.

    Raises:
        ValueError: not one credit an item.
    """
    groups, correct = np.asarray(groups, str), np.asarray(correct, float)
    if groups.shape != correct.shape:
        raise ValueError(f"{len(groups)} groups for {len(correct)} items")
    return {str(g): _interval(correct[groups == g]) for g in np.unique(groups)}


def accuracy_by_family(families: Sequence[str], correct: Sequence[float]) -> Accuracy:
    """Accuracy by family, their plain mean (macro) over the families present, and over all items
    (micro).

    Raises:
        ValueError: no items, not one credit an item, or a family that does not exist.
    """
    found = accuracy_by_group(families, correct)
    if not found or set(found) - set(FAMILIES):
        raise ValueError(f"families {sorted(found)}: expected some of {', '.join(FAMILIES)}")
    ordered = {f: found[f] for f in FAMILIES if f in found}
    macro = float(np.mean([i.value for i in ordered.values()]))
    return Accuracy(ordered, macro, _interval(np.asarray(correct, float)))


def _interval(correct: np.ndarray) -> Interval:
    return Interval(
        float(correct.mean()), *wilson_interval(float(correct.sum()), len(correct)), len(correct)
    )
