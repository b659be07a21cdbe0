"""Calibration of the confidences that models report, and their preference for letters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynapix.data.records import LETTERS

BINS = 10
"""Number of confidence bins, which have equal width."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of `n` answers.

    Attributes:
        confidence: Mean confidence.
        accuracy: Share of correct answers.
        ece: Expected calibration error: the absolute difference between mean confidence and
            accuracy in a bin, averaged over the bins with their numbers of answers as weights.
        brier: Brier score: the mean squared difference between confidence and correctness.
    """

    confidence: float
    accuracy: float
    ece: float
    brier: float
    n: int


def measure_calibration(
    confidence: Sequence[float], correct: Sequence[float]
) -> Calibration | None:
    """Compare the confidence in each answer, from 0 to 1, with its correctness: 1 for a correct
    answer, 0 for a wrong one. Return None if there are no answers."""
    confidence, correct = np.asarray(confidence, float), np.asarray(correct, float)
    if not len(confidence):
        return None
    differences = confidence - correct
    # The last bin includes 1.
    bin_of = np.minimum((confidence * BINS).astype(int), BINS - 1)
    ece = np.abs(np.bincount(bin_of, differences)).sum() / len(confidence)
    brier = (differences**2).mean()
    values = (confidence.mean(), correct.mean(), ece, brier)
    return Calibration(*map(float, values), len(confidence))


@dataclass(frozen=True)
class PositionBias:
    """Numbers of items by letter: items for which a model chose the letter (`chosen`), items whose
    correct letter it is (`right`), and items for which both are true (`hits`)."""

    chosen: dict[str, int]
    right: dict[str, int]
    hits: dict[str, int]


def measure_position_bias(chosen: Sequence[str | None], right: Sequence[str]) -> PositionBias:
    """Compare the letters that a model chose, or None, with the correct letters (`right`)."""
    hits = [c for c, r in zip(chosen, right, strict=True) if c == r]
    counts = ({x: list(letters).count(x) for x in LETTERS} for letters in (chosen, right, hits))
    return PositionBias(*counts)
