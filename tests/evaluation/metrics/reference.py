"""Reference implementations, with which tests compare the metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dynapix.evaluation.metrics.ranking import count_above_and_equal, query_metrics, target_scores


def scene_interval(
    values: np.ndarray,
    scenes: Sequence[str],
    statistic: Callable[[np.ndarray], float],
    seed: int,
    resamples: int = 2000,
) -> tuple[float, float]:
    """Return the 95% percentile bootstrap interval of a statistic, by resampling scenes."""
    rows = [np.flatnonzero(np.asarray(scenes) == scene) for scene in np.unique(scenes)]
    sampled = np.random.default_rng(seed).integers(len(rows), size=(resamples, len(rows)))
    results = [statistic(values[np.concatenate([rows[i] for i in picks])]) for picks in sampled]
    low, high = np.percentile(results, [2.5, 97.5])
    return float(low), float(high)


def count_ranks(scores: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the frames above each target, and the other frames with its score. Both are 0 if the
    target's score is NaN."""
    above, equal = count_above_and_equal(scores, target_scores(scores, targets))
    return above, np.maximum(equal - 1, 0)


def matrix_metrics(scores: np.ndarray, targets: np.ndarray, ks: Sequence[int]) -> dict[str, float]:
    """Return the ranking metrics of scores (queries, frames); `targets` are columns (queries,)."""
    scores = np.asarray(scores)
    valid = ~np.isnan(target_scores(scores, targets))
    return ranking_metrics(*count_ranks(scores, targets), valid, np.shape(scores)[1], ks)


def ranking_metrics(
    above: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, float]:
    """Return the means of `query_metrics` over all queries, and the median of `median_rank`."""
    measures = query_metrics(above, tied, valid, frames, ks)
    return {
        name: float((np.median if name == "median_rank" else np.mean)(values))
        for name, values in measures.items()
    }
