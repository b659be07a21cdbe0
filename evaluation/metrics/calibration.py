"""Calibration of reported confidences, and preference for a candidate's position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import LETTERS
from evaluation.metrics.intervals import Interval, mean_with_wilson

BINS = 10
"""Confidence bins of equal width."""


@dataclass(frozen=True)
class Bin:
    """Mean confidence and accuracy of the answers with a confidence in [low, high).

    The last bin includes 1.
    """

    low: float
    high: float
    confidence: float
    accuracy: Interval


@dataclass(frozen=True)
class Calibration:
    """Calibration of `n` answers.

    Attributes:
        ece: Expected calibration error, the mean gap between confidence and accuracy of the bins,
            weighted by their answers.
        brier: Brier score, the mean squared gap of the answers.
        bins: The bins with answers.
    """

    ece: float
    brier: float
    n: int
    bins: list[Bin]


def measure_calibration(
    confidence: Sequence[float], correct: Sequence[float]
) -> Calibration | None:
    """Compare confidences, each from 0 to 1, with whether the answers are right; None without
    answers."""
    confidence, correct = np.asarray(confidence, float), np.asarray(correct, float)
    if not len(confidence):
        return None
    bin_of = np.minimum((confidence * BINS).astype(int), BINS - 1)
    bins = []
    for k in np.unique(bin_of):
        mean, accuracy = confidence[bin_of == k].mean(), mean_with_wilson(correct[bin_of == k])
        bins.append(Bin(float(k / BINS), float((k + 1) / BINS), float(mean), accuracy))
    gaps = [b.accuracy.n * abs(b.confidence - b.accuracy.value) for b in bins]
    brier = float(((confidence - correct) ** 2).mean())
    return Calibration(float(sum(gaps) / len(confidence)), brier, len(confidence), bins)


@dataclass(frozen=True)
class PositionBias:
    """Chosen letters against correct ones.

    Attributes:
        chosen, right: How often each letter was chosen, and was correct.
        hits: How often the model was right where each letter was correct.
        chi_square, p: Test of the chosen letters against the frequencies of the correct ones; a
            small p means that the model prefers a position. None without a choice, or if a letter
            is never correct.
    """

    chosen: dict[str, int]
    right: dict[str, int]
    hits: dict[str, int]
    chi_square: float | None
    p: float | None


def measure_position_bias(chosen: Sequence[str | None], right: Sequence[str]) -> PositionBias:
    """Compare a model's letters, None for items without one, with the correct letters."""
    from scipy.stats import chisquare

    pairs = list(zip(chosen, right, strict=True))
    made = [letter for letter, _ in pairs if letter is not None]
    observed, truth = ({x: letters.count(x) for x in LETTERS} for letters in (made, list(right)))
    hits = {x: sum(c == r == x for c, r in pairs) for x in LETTERS}
    if not made or not all(truth.values()):
        return PositionBias(observed, truth, hits, None, None)
    expected = np.array([truth[x] for x in LETTERS]) * len(made) / len(pairs)
    test = chisquare([observed[x] for x in LETTERS], expected)
    return PositionBias(observed, truth, hits, float(test.statistic), float(test.pvalue))
