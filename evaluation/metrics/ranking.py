"""Recall, reciprocal rank and rank of each query's target.

Every measure follows from two counts per query: the number of frames that score above the target,
and the number of other frames with exactly the target's score. If frames tie with the target, a
measure is its mean over all orders of these frames, so that constant scores give chance accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import digamma


def target_scores(scores: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the score of each query's target as fp32 (queries,).

    Args:
        scores: (queries, frames).
        columns: (queries,) the column of each query's target.
    """
    return np.asarray(scores, np.float32)[np.arange(len(columns)), columns]


def count_above_and_equal(scores: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count, for each query, the frames that score above its target and those with an equal score.

    The counts of several blocks of columns can be added. The target's own column counts as equal.
    NaN is neither above nor equal.

    Args:
        scores: (queries, frames), all columns of the score matrix or a block of them.
        targets: (queries,) the score of each query's target, as `target_scores` returns it. It must
            come from the same matrix product as `scores`: a score that is computed separately can
            differ in its last bit, and then the target would not be equal to itself.

    Returns:
        Two integer arrays (queries,): above and equal.
    """
    scores = np.asarray(scores, np.float32)
    targets = np.asarray(targets, np.float32)[:, None]
    return (scores > targets).sum(1), (scores == targets).sum(1)


def expected_hits(greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, k: int) -> np.ndarray:
    """Return the probability (queries,) that a query's target ranks among the first `k` frames if
    ties are broken at random.

    With k = 1 this is the credit of a retriever on a selection item: 1/m if the target is one of m
    candidates with the highest score. The other arguments are those of `query_metrics`.
    """
    hits = np.clip((k - np.asarray(greater)) / (np.asarray(tied) + 1), 0, 1)
    return np.where(valid, hits, 0.0)


def query_metrics(
    greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the measures of each query by name.

    Args:
        greater, tied: (queries,) numbers of frames that score above the target, and of other frames
            with the target's score.
        valid: (queries,) False for a query without a response or with a NaN target score. Such a
            query has recall 0, reciprocal rank 0 and the last rank, `frames`.
        frames: Number of frames in the database.
        ks: Cut-offs of the recalls.

    Returns:
        Arrays (queries,): `recall@k` for each k; the reciprocal rank `mrr`; the target's rank
        `median_rank` (reports give its median), to which each tied frame adds one half; and
        `tie_rate`, 1 if another frame ties with the target.
    """
    greater, tied, valid = np.asarray(greater), np.asarray(tied), np.asarray(valid, bool)
    # The sum of 1/rank over the tied ranks is a difference of harmonic numbers.
    harmonic = digamma(greater + tied + 2) - digamma(greater + 1)
    return {
        **{f"recall@{k}": expected_hits(greater, tied, valid, k) for k in ks},
        "mrr": np.where(valid, harmonic / (tied + 1), 0.0),
        "median_rank": np.where(valid, greater + 1 + tied / 2, frames),
        "tie_rate": (valid & (tied > 0)).astype(float),
    }
