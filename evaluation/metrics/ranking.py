"""Ranking measures from scores or from counts of frames above and tied with a query's target."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import digamma


def target_scores(scores: np.ndarray, gold: np.ndarray) -> np.ndarray:
    """The fp32 scores (queries,) of the gold columns; NaN where there is none.

    Args:
        scores: (queries, frames), numpy or a CPU tensor that numpy can read.
        gold: (queries,) column indices; below 0, NaN or None where there is none.

    Raises:
        ValueError: shapes that do not fit, a gold column past the last frame, or one that is no
            whole number.
    """
    scores, gold = np.asarray(scores, np.float32), _columns(gold)
    if scores.ndim != 2 or gold.shape != scores.shape[:1]:
        raise ValueError(
            f"scores {scores.shape} and gold {gold.shape}: "
            "expected (queries, frames) and (queries,)"
        )
    if gold.size and gold.max() >= scores.shape[1]:
        raise ValueError(f"gold column {gold.max()} is past the last of {scores.shape[1]} frames")
    own = np.full(len(gold), np.nan, np.float32)
    there = np.flatnonzero(gold >= 0)
    own[there] = scores[there, gold[there]]
    return own


def _columns(gold: Sequence[float | None] | np.ndarray) -> np.ndarray:
    given = np.asarray(gold)
    if given.dtype == bool:
        raise ValueError("gold columns are true or false: expected whole numbers")
    numbers = np.asarray(given, float)
    told = np.where(np.isnan(numbers), -1, numbers)
    if not np.isfinite(told).all() or (told != np.floor(told)).any():
        raise ValueError("gold columns must be whole numbers")
    return told.astype(np.int64)


def count_above_and_equal(scores: np.ndarray, gold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many columns score above, and exactly as, each query's gold score.

    The sums over blocks of columns are those of the whole matrix, which is how a database is ranked
    a block at a time. Over all columns the second count holds the gold frame itself: subtract 1 for
    the tied others. NaN is neither above nor equal.

    Args:
        scores: (queries, frames), a block of any width.
        gold: (queries,) scores from `gold_scores`. They must come out of the same product
            as `scores`: one computed apart can differ in its last bit and tie with nothing, or
            lose to itself.

    Returns:
        Two integer arrays (queries,).
    """
    scores = np.asarray(scores, np.float32)
    gold = np.asarray(gold, np.float32)[:, None]
    return (scores > gold).sum(1), (scores == gold).sum(1)


def count_ranks(scores: np.ndarray, gold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames strictly above the gold frame, and other frames tied with it: two (queries,) arrays.

    Both are 0 for a query without a gold score; `gold_scores` says which those are (NaN).
    Arguments and errors are those of `gold_scores`.
    """
    greater, equal = count_above_and_equal(scores, target_scores(scores, gold))
    return greater, np.maximum(equal - 1, 0)


def expected_hits(greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, k: int) -> np.ndarray:
    """Each query's chance (queries,) to be among the first `k` when ties fall at random.

    With k = 1 this is the credit of a similarity scorer on a selection item: 1/m where the right
    candidate is one of m maxima.
    """
    hits = np.clip((k - np.asarray(greater)) / (np.asarray(tied) + 1), 0, 1)
    return np.where(valid, hits, 0.0)


def ranking_metrics(
    greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, float]:
    """Means over all queries, misses among them.

    Args:
        greater, tied: (queries,) counts as `ranks_of` gives them.
        valid: (queries,) False for a miss: a query that was not answered or whose gold score is
            NaN. It has no hit, a reciprocal rank of 0 and the last rank, `frames`.
        frames: size of the database.
        ks: cut-offs of the recalls.

    Returns:
        `recall@k` for each k, `mrr`, `median_rank` (1 is best; ties count half) and `tie_rate`, the
        share of queries whose gold frame ties with another.

    Raises:
        ValueError: no query at all.
    """
    each = query_metrics(greater, tied, valid, frames, ks)
    return {name: float(summary(name)(values)) for name, values in each.items()}


def query_metrics(
    greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, np.ndarray]:
    """Each query's part (queries,) in the measures that `metrics_from_counts` sums up, by name.

    Raises:
        ValueError: no query at all.
    """
    greater, tied, valid = np.asarray(greater), np.asarray(tied), np.asarray(valid, bool)
    if not len(greater):
        raise ValueError("no queries to measure")
    harmonic = digamma(greater + tied + 2) - digamma(greater + 1)
    return {
        **{f"recall@{k}": expected_hits(greater, tied, valid, k) for k in ks},
        "mrr": np.where(valid, harmonic / (tied + 1), 0.0),
        "median_rank": np.where(valid, greater + 1 + tied / 2, frames),
        "tie_rate": (valid & (tied > 0)).astype(float),
    }


def summary(measure: str) -> Callable[[np.ndarray], float]:
    """What makes one number of every query's part in a measure."""
    return np.median if measure == "median_rank" else np.mean


def ranking_metrics_of_scores(
    scores: np.ndarray, gold: np.ndarray, ks: Sequence[int]
) -> dict[str, float]:
    """`metrics_from_counts` of one score matrix (queries, frames) and its gold columns (queries,).

    A gold column that is negative, NaN or None, or a NaN gold score, is a miss. Scores are compared
    in fp32. Errors are those of `gold_scores`, and ValueError where there is no query.
    """
    valid = ~np.isnan(target_scores(scores, gold))
    return ranking_metrics(*count_ranks(scores, gold), valid, np.shape(scores)[1], ks)
