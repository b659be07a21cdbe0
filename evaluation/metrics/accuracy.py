"""Accuracy by family and by other groups of items, as shares between 0 and 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import FAMILIES
from evaluation.metrics.intervals import Interval, mean_with_wilson


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of each family that has items, their plain mean (macro) and that of all items."""

    families: dict[str, Interval]
    macro: float
    micro: Interval


def accuracy_by_group(groups: Sequence[str], credits: Sequence[float]) -> dict[str, Interval]:
    """Return the accuracy of each group of items, in order of name, with Wilson intervals.

    Args:
        groups: One name per item, such as its family, subtype or horizon.
        credits: One credit per item: a bool, or the 1/m of a tie among m candidates.
    """
    groups, credits = np.asarray(groups, str), np.asarray(credits, float)
    return {str(g): mean_with_wilson(credits[groups == g]) for g in np.unique(groups)}


def accuracy_by_family(families: Sequence[str], credits: Sequence[float]) -> Accuracy:
    """Return the accuracy by family, in the order of `FAMILIES`, and over all items."""
    by_family = accuracy_by_group(families, credits)
    ordered = {f: by_family[f] for f in FAMILIES if f in by_family}
    macro = float(np.mean([i.value for i in ordered.values()]))
    return Accuracy(ordered, macro, mean_with_wilson(np.asarray(credits, float)))
