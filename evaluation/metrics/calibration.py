"""Calibration of reported confidences, and preference for a letter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import LETTERS

BINS = 10
"""Confidence bins of equal width."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of `n` answers.

    Attributes:
        confidence: Mean confidence.
        accuracy: Share of correct answers.
        ece: Expected calibration error, the mean difference between confidence and accuracy in each
            bin, weighted by its answers.
        brier: Brier score, the mean squared difference over the answers.
    """

    confidence: float
    accuracy: float
    ece: float
    brier: float
    n: int


def measure_calibration(
    confidence: Sequence[float], correct: Sequence[float]
) -> Calibration | None:
    """Compare confidences from 0 to 1 with correctness from 0 to 1; None without answers."""
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
    """How often each letter was chosen, was correct, and was chosen where it was correct."""

    chosen: dict[str, int]
    right: dict[str, int]
    hits: dict[str, int]


def measure_position_bias(chosen: Sequence[str | None], right: Sequence[str]) -> PositionBias:
    """Compare a model's letters, None for items without one, with the correct letters."""
    hits = [c for c, r in zip(chosen, right, strict=True) if c == r]
    counts = ({x: list(letters).count(x) for x in LETTERS} for letters in (chosen, right, hits))
    return PositionBias(*counts)
