"""Accuracy by family and by other groups of items, as shares between 0 and 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import FAMILIES
from evaluation.metrics.intervals import Interval, wilson_interval


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of each family that has items, in the order event, time, window."""

    families: dict[str, Interval]
    macro: float
    micro: Interval


def accuracy_by_group(groups: Sequence[str], credits: Sequence[float]) -> dict[str, Interval]:
    """Return the accuracy of each group of items, in order of name, with Wilson intervals.

    Args:
        groups: One name per item, such as its family, subtype or horizon.
        credits: One credit per item: a bool, or the 1/m of a tie among m candidates.

    Raises:
        ValueError: The arguments differ in length.
    """
    groups, credits = np.asarray(groups, str), np.asarray(credits, float)
    if groups.shape != credits.shape:
        raise ValueError(f"{len(groups)} groups for {len(credits)} items")
    return {str(g): _accuracy(credits[groups == g]) for g in np.unique(groups)}


def accuracy_by_family(families: Sequence[str], credits: Sequence[float]) -> Accuracy:
    """Return the accuracy by family, their plain mean (macro) and that of all items (micro).

    Raises:
        ValueError: There are no items, the arguments differ in length, or a family is unknown.
    """
    by_family = accuracy_by_group(families, credits)
    if not by_family or set(by_family) - set(FAMILIES):
        raise ValueError(f"families {sorted(by_family)}: expected some of {', '.join(FAMILIES)}")
    ordered = {f: by_family[f] for f in FAMILIES if f in by_family}
    macro = float(np.mean([i.value for i in ordered.values()]))
    return Accuracy(ordered, macro, _accuracy(np.asarray(credits, float)))


def _accuracy(credits: np.ndarray) -> Interval:
    low, high = wilson_interval(float(credits.sum()), len(credits))
    return Interval(float(credits.mean()), low, high, len(credits))
