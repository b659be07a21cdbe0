"""Recall, reciprocal rank and median rank of each query's target, with ties counted fairly.

Every measure follows from two counts per query: the frames that score above the target, and the
other frames that score exactly as it does. A tie counts as its mean over all orders of the tied
frames, so that a constant scorer has chance accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import digamma


def target_scores(scores: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return each query's score of its target as fp32 (queries,).

    Args:
        scores: (queries, frames).
        targets: (queries,) columns.
    """
    return np.asarray(scores, np.float32)[np.arange(len(targets)), targets]


def count_above_and_equal(scores: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the columns that score above, and exactly as, each query's target.

    Counts of blocks of columns add up to those of the whole matrix. Over all columns, the second
    count includes the target itself. NaN is neither above nor equal.

    Args:
        scores: (queries, frames), a block of any width.
        targets: (queries,) scores from `target_scores`. They must come from the same product as
            `scores`: a score that is computed separately can differ in its last bit, and then
            ties with nothing or loses to itself.

    Returns:
        Two integer arrays (queries,).
    """
    scores = np.asarray(scores, np.float32)
    targets = np.asarray(targets, np.float32)[:, None]
    return (scores > targets).sum(1), (scores == targets).sum(1)


def expected_hits(greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, k: int) -> np.ndarray:
    """Return each query's probability (queries,) to rank among the first `k` under random ties.

    With k = 1 this is the credit of a similarity scorer on a selection item: 1/m if the target is
    one of m maxima.
    """
    hits = np.clip((k - np.asarray(greater)) / (np.asarray(tied) + 1), 0, 1)
    return np.where(valid, hits, 0.0)


def query_metrics(
    greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return each query's measures (queries,) by name.

    Args:
        greater, tied: (queries,) counts of frames above the target and of others tied with it.
        valid: (queries,) False for a miss: a query without a response or with a NaN target score.
            It has no hit, a reciprocal rank of 0 and the last rank, `frames`.
        frames: Size of the database.
        ks: Cut-offs of the recalls.

    Returns:
        `recall@k` for each k, `mrr`, `median_rank` (1 is best; ties count half) and `tie_rate`,
        whether the target ties with another frame.
    """
    greater, tied, valid = np.asarray(greater), np.asarray(tied), np.asarray(valid, bool)
    # The mean of 1/rank over the tied ranks is a difference of harmonic numbers.
    harmonic = digamma(greater + tied + 2) - digamma(greater + 1)
    return {
        **{f"recall@{k}": expected_hits(greater, tied, valid, k) for k in ks},
        "mrr": np.where(valid, harmonic / (tied + 1), 0.0),
        "median_rank": np.where(valid, greater + 1 + tied / 2, frames),
        "tie_rate": (valid & (tied > 0)).astype(float),
    }
