"""Whether a model is as often right as it says, and whether it favours a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data.records import LETTERS
from evaluation.metrics.intervals import Interval, wilson_interval

BINS = 10
"""Bins of equal width that confidences are sorted into."""


@dataclass(frozen=True)
class Bin:
    """Answers whose confidence lies from `low` up to `high` (the last bin holds 1): their mean
    confidence, and how many are right."""

    low: float
    high: float
    confidence: float
    accuracy: Interval


@dataclass(frozen=True)
class Calibration:
    """Of `n` answers: the expected calibration error, the bins' gaps between confidence and
    accuracy weighed by their answers; the Brier score, the mean squared gap of each; and the bins
    that hold any."""

    ece: float
    brier: float
    n: int
    bins: list[Bin]

    @classmethod
    def from_dict(cls, told: dict[str, Any]) -> Calibration:
        bins = [Bin(**{**b, "accuracy": Interval(**b["accuracy"])}) for b in told["bins"]]
        return cls(**{**told, "bins": bins})


def measure_calibration(
    confidence: Sequence[float], correct: Sequence[float]
) -> Calibration | None:
    """How reported confidences go with what is right; None of no answers.

    Args:
        confidence: of each answer, from 0 to 1.
        correct: whether it is right.

    Raises:
        ValueError: not one confidence an answer, or one that is no share.
    """
    told, right = np.asarray(confidence, float), np.asarray(correct, float)
    if told.shape != right.shape or not ((told >= 0) & (told <= 1)).all():
        raise ValueError(f"{len(told)} confidences from 0 to 1 for {len(right)} answers")
    if not len(told):
        return None
    of = np.minimum((told * BINS).astype(int), BINS - 1)
    bins = []
    for k in np.unique(of):
        mean, hits = told[of == k].mean(), right[of == k]
        accuracy = Interval(hits.mean(), *wilson_interval(hits.sum(), len(hits)), len(hits))
        bins.append(Bin(float(k / BINS), float((k + 1) / BINS), float(mean), accuracy))
    gaps = [b.accuracy.n * abs(b.confidence - b.accuracy.value) for b in bins]
    brier = float(((told - right) ** 2).mean())
    return Calibration(float(sum(gaps) / len(told)), brier, len(told), bins)


@dataclass(frozen=True)
class PositionBias:
    """Which letters a model chose and which were right, as counts in their order, and how often it
    was right where each was; of all items, those without a choice among them. `chi_square` and `p`
    hold what it chose against how often each was right: a small p says that it favours a position.
    Both are None without a choice, or where a letter is never right."""

    chosen: dict[str, int]
    right: dict[str, int]
    hits: dict[str, int]
    chi_square: float | None
    p: float | None


def measure_position_bias(chosen: Sequence[str | None], right: Sequence[str]) -> PositionBias:
    """How a model's letters go with the right ones, an item each.

    Raises:
        ValueError: not one choice an item.
    """
    from scipy.stats import chisquare

    pairs = list(zip(chosen, right, strict=True))
    own = [c for c, _ in pairs if c is not None]
    mine, theirs = ({x: letters.count(x) for x in LETTERS} for letters in (own, list(right)))
    hits = {x: sum(c == r == x for c, r in pairs) for x in LETTERS}
    if not own or not all(theirs.values()):
        return PositionBias(mine, theirs, hits, None, None)
    expected = np.array([theirs[x] for x in LETTERS]) * len(own) / len(pairs)
    test = chisquare([mine[x] for x in LETTERS], expected)
    return PositionBias(mine, theirs, hits, float(test.statistic), float(test.pvalue))
