"""Recall, reciprocal rank and rank of each query's target.

Every measure follows from two counts per query: the number of frames that score above the target,
and the number of other frames with exactly the target's score. If frames tie with the target, a
measure is its mean over all orders of these frames, so that constant scores give chance accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np

from dynapix.conf.errors import UserError


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
        targets: (queries,) the score of each query's target, bit-identical to its entry in the
            matrix of scores: otherwise, the target would not be equal to itself.

    Returns:
        Two integer arrays (queries,): above and equal.
    """
    scores = np.asarray(scores, np.float32)
    targets = np.asarray(targets, np.float32)[:, None]
    return (scores > targets).sum(1), (scores == targets).sum(1)


def share_above(scores: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the probability that each frame ranks above its query's target, if ties are broken at
    random: 1, 1/2 for an equal score, or 0."""
    return (scores > targets) + (scores == targets) / 2


def expected_hits(above: np.ndarray, tied: np.ndarray, valid: np.ndarray, k: int) -> np.ndarray:
    """Return the probability (queries,) that a query's target ranks among the first `k` frames if
    ties are broken at random.

    With k = 1 this is the credit of a retriever on a selection item: 1/m if the target is one of m
    candidates with the highest score. The other arguments are those of `query_metrics`.
    """
    hits = np.clip((k - np.asarray(above)) / (np.where(valid, tied, 0) + 1), 0, 1)
    return np.where(valid, hits, 0.0)


def query_metrics(
    above: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the measures of each query by name.

    Args:
        above, tied: (queries,) numbers of frames that score above the target, and of other frames
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
    above, tied, valid = np.asarray(above), np.asarray(tied), np.asarray(valid, bool)
    # The sum of 1/rank over the tied ranks is a difference of harmonic numbers.
    harmonic = np.concatenate([[0.0], np.cumsum(1 / np.arange(1, frames + 1))])
    reciprocals = harmonic[above + np.where(valid, tied, 0) + 1] - harmonic[above]
    return {
        **{f"recall@{k}": expected_hits(above, tied, valid, k) for k in ks},
        "mrr": np.where(valid, reciprocals / np.where(valid, tied + 1, 1), 0.0),
        "median_rank": np.where(valid, above + 1 + tied / 2, frames),
        "tie_rate": (valid & (tied > 0)).astype(float),
    }


def rank_metrics(
    scores: np.ndarray, gold: Sequence[int], ks: Sequence[int] = (1, 10, 50)
) -> dict[str, float]:
    """Return recall, mean reciprocal rank, median rank and rate of ties of a matrix of scores.

    Scores are compared in fp32. If frames tie with the target, each measure is its mean over all
    orders of the tied frames. A frame whose score is NaN ranks below the target.

    Args:
        scores: (queries, frames); a higher score ranks first.
        gold: (queries,) the column of each query's target. A query whose column is negative, or
            whose target's score is NaN, is a miss: it has recall 0, reciprocal rank 0 and the last
            rank, and counts in every mean.
        ks: Cut-offs of the recalls.

    Returns:
        `recall@k` for each k, `mrr`, `median_rank` (1 is best) and `tie_rate`.

    Raises:
        UserError: The arguments have other shapes or values.
    """
    try:
        scores, columns = to_array(scores, np.float32), to_array(gold)
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise UserError(
            f"scores or gold are not arrays of numbers: {error}", code="invalid-scores"
        ) from error
    if scores.ndim != 2 or not scores.size or columns.shape != scores.shape[:1]:
        raise UserError(
            f"scores have the shape {scores.shape} and gold has {columns.shape}: give scores "
            "(queries, frames) and one column per query",
            code="invalid-scores",
        )
    if not np.issubdtype(columns.dtype, np.integer) or columns.max() >= scores.shape[1]:
        raise UserError(
            f"gold must be whole numbers below {scores.shape[1]}, the columns of scores",
            code="invalid-scores",
        )
    cutoffs = np.atleast_1d(np.asarray(ks, object)).ravel().tolist()
    if not cutoffs or not all(isinstance(k, Integral) and k >= 1 for k in cutoffs):
        raise UserError(
            f"ks={ks}: give cut-offs, whole numbers of 1 or more", code="invalid-scores"
        )
    targets = np.where(columns >= 0, target_scores(scores, np.maximum(columns, 0)), np.nan)
    above, equal = count_above_and_equal(scores, targets)
    measures = query_metrics(above, equal - 1, ~np.isnan(targets), scores.shape[1], cutoffs)
    return {
        name: float(np.median(values) if name == "median_rank" else np.mean(values))
        for name, values in measures.items()
    }


def to_array(values: Any, dtype: Any = None) -> np.ndarray:
    """Return numbers as an array: those of an array, of a tensor on any device, also with gradients
    or in bf16, or of nested lists of them. Raises the errors of numpy and of torch."""
    try:
        return np.asarray(values, dtype)
    except (RuntimeError, TypeError, ValueError):
        return np.asarray(_detach(values), dtype)


def _detach(values: Any) -> Any:
    if isinstance(values, list | tuple):
        return [_detach(value) for value in values]
    if not hasattr(values, "detach"):
        return values
    tensor = values.detach().cpu()
    return (tensor.double() if tensor.is_floating_point() else tensor).numpy()
