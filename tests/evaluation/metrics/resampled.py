"""The bootstrap over scenes as it is written in books."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np


def interval(
    values: np.ndarray,
    scenes: Sequence[str],
    statistic: Callable[[np.ndarray], float],
    seed: int,
    resamples: int = 2000,
) -> tuple[float, float]:
    """The 95% percentile interval of a statistic of the rows of scenes that are drawn again."""
    rows = [np.flatnonzero(np.asarray(scenes) == scene) for scene in np.unique(scenes)]
    drawn = np.random.default_rng(seed).integers(len(rows), size=(resamples, len(rows)))
    results = [statistic(values[np.concatenate([rows[i] for i in picks])]) for picks in drawn]
    low, high = np.percentile(results, [2.5, 97.5])
    return float(low), float(high)
