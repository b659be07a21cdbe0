"""Reference implementations that the metrics are compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from evaluation.metrics.ranking import count_above_and_equal, query_metrics, target_scores


def scene_interval(
    values: np.ndarray,
    scenes: Sequence[str],
    statistic: Callable[[np.ndarray], float],
    seed: int,
    resamples: int = 2000,
) -> tuple[float, float]:
    """The 95% percentile interval of a statistic of the rows of resampled scenes."""
    rows = [np.flatnonzero(np.asarray(scenes) == scene) for scene in np.unique(scenes)]
    sampled = np.random.default_rng(seed).integers(len(rows), size=(resamples, len(rows)))
    results = [statistic(values[np.concatenate([rows[i] for i in picks])]) for picks in sampled]
    low, high = np.percentile(results, [2.5, 97.5])
    return float(low), float(high)


def count_ranks(scores: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the frames above each target and the others tied with it; 0 for a NaN target score."""
    greater, equal = count_above_and_equal(scores, target_scores(scores, targets))
    return greater, np.maximum(equal - 1, 0)


def matrix_metrics(scores: np.ndarray, targets: np.ndarray, ks: Sequence[int]) -> dict[str, float]:
    """Ranking metrics of a score matrix (queries, frames) and its target columns (queries,)."""
    scores = np.asarray(scores)
    valid = ~np.isnan(target_scores(scores, targets))
    return ranking_metrics(*count_ranks(scores, targets), valid, np.shape(scores)[1], ks)


def ranking_metrics(
    greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, frames: int, ks: Sequence[int]
) -> dict[str, float]:
    """Summarize `query_metrics` over all queries, misses included."""
    measures = query_metrics(greater, tied, valid, frames, ks)
    return {
        name: float((np.median if name == "median_rank" else np.mean)(values))
        for name, values in measures.items()
    }
