"""95% confidence intervals of means and medians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Interval:
    """A statistic of `n` items, such as their accuracy, with its 95% confidence interval."""

    value: float
    low: float
    high: float
    n: int


def mean_with_wilson(values: np.ndarray) -> Interval:
    """Return the mean of values from 0 to 1, such as credits, with its Wilson interval."""
    # statsmodels takes longer to import than everything else that --help needs.
    from statsmodels.stats.proportion import proportion_confint

    low, high = proportion_confint(values.sum(), len(values), method="wilson")
    return Interval(float(values.mean()), float(low), float(high), len(values))


class SceneBootstrap:
    """95% percentile bootstrap intervals, in which scenes are resampled with all of their items.

    The items of a scene share its video, so resampling single items would give intervals that are
    too narrow. The resamples are drawn once and reused for every statistic of the items. Each is
    stored as the number of times that it contains each item.
    """

    def __init__(self, scenes: Sequence[str], seed: int, resamples: int = 2000) -> None:
        """`scenes` names the scene of each item."""
        _, codes = np.unique(np.asarray(scenes), return_inverse=True)
        count = codes.max() + 1
        sampled = np.random.default_rng(seed).integers(count, size=(resamples, count))
        cells = sampled + count * np.arange(resamples)[:, None]
        scene_counts = np.bincount(cells.ravel(), minlength=sampled.size).reshape(sampled.shape)
        self._counts = scene_counts.astype(np.int32)[:, codes]

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the interval of the mean of `values` (items,), as an array [low, high]."""
        return _percentiles(self._counts @ values / self._counts.sum(1))

    def median(self, values: np.ndarray) -> np.ndarray:
        """Return the interval [low, high] of the median of `values` (items,)."""
        order = np.argsort(values, kind="stable")
        cumulative = np.cumsum(self._counts[:, order], axis=1, dtype=np.int32)
        total = cumulative[:, -1:]
        # The median of an even number of items is the mean of the middle two.
        middle = [(cumulative > index).argmax(1) for index in ((total - 1) // 2, total // 2)]
        return _percentiles(np.asarray(values, float)[order][middle].mean(0))

    def macro(self, values: np.ndarray, groups: Sequence[str]) -> np.ndarray:
        """Return the interval [low, high] of the unweighted mean of the groups' means of `values`.

        If a resample has no item of a group, its mean is over the other groups.
        """
        _, codes = np.unique(np.asarray(groups), return_inverse=True)
        member = np.eye(codes.max() + 1)[codes]
        sums, counts = self._counts @ (member * values[:, None]), self._counts @ member
        means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
        return _percentiles(np.nanmean(means, axis=1))


def macro_by_scene(
    values: Sequence[float], groups: Sequence[str], scenes: Sequence[str], seed: int
) -> Interval:
    """Return the unweighted mean of the groups' means, with its interval from `SceneBootstrap`.

    Args:
        values: A number for each item. Credits (see `accuracy_by_group`) give a macro accuracy;
            differences of credits give the difference between two macro accuracies.
        groups: The name of each item's group, such as its family.
        scenes: The name of each item's scene.
    """
    values, groups = np.asarray(values, float), np.asarray(groups)
    low, high = SceneBootstrap(scenes, seed).macro(values, groups)
    mean = np.mean([values[groups == g].mean() for g in np.unique(groups)])
    return Interval(float(mean), float(low), float(high), len(values))


def _percentiles(results: np.ndarray) -> np.ndarray:
    return np.percentile(results, [2.5, 97.5])
