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

    def mean(self, values: Sequence[float]) -> Interval:
        """Return the mean of the values (items,)."""
        values = np.asarray(values, float)
        return interval_of(values.mean(), self._counts @ values / self._counts.sum(1), len(values))

    def ratio(self, parts: Sequence[float], wholes: Sequence[float]) -> Interval:
        """Return the sum of the parts (items,) divided by the sum of the wholes (items,), of which
        at least one is positive. Resamples whose wholes are all 0 do not count."""
        parts, wholes = np.asarray(parts, float), np.asarray(wholes, float)
        resampled = divide(self._counts @ parts, self._counts @ wholes)
        return interval_of(parts.sum() / wholes.sum(), resampled, len(parts))

    def median(self, values: Sequence[float]) -> Interval:
        """Return the median of the values (items,)."""
        values = np.asarray(values, float)
        order = np.argsort(values, kind="stable")
        cumulative = np.cumsum(self._counts[:, order], axis=1, dtype=np.int32)
        total = cumulative[:, -1:]
        # The median of an even number of items is the mean of the middle two.
        middle = [(cumulative > index).argmax(1) for index in ((total - 1) // 2, total // 2)]
        return interval_of(np.median(values), values[order][middle].mean(0), len(values))

    def group_means(self, values: Sequence[float], groups: Sequence[str]) -> dict[str, Interval]:
        """Return the mean of the values of each group, sorted by group.

        Scenes are resampled as for all items. A resample without an item of a group does not count
        for the interval of that group.

        Args:
            values: (items,), such as the credit for each item.
            groups: The name of each item's group, such as its family.
        """
        values, groups = np.asarray(values, float), np.asarray(groups, str)
        names, resampled = self._resample_groups(values, groups)
        members = [values[groups == name] for name in names]
        return {
            str(name): interval_of(own.mean(), resampled[:, k], len(own))
            for k, (name, own) in enumerate(zip(names, members, strict=True))
        }

    def macro(self, values: Sequence[float], groups: Sequence[str]) -> Interval:
        """Return the unweighted mean of the groups' means of the values (items,).

        If a resample has no item of a group, its mean is over the other groups.
        """
        values, groups = np.asarray(values, float), np.asarray(groups, str)
        names, resampled = self._resample_groups(values, groups)
        mean = np.mean([values[groups == name].mean() for name in names])
        return interval_of(mean, np.nanmean(resampled, axis=1), len(values))

    def _resample_groups(
        self, values: np.ndarray, groups: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups' names, and their means in each resample (resamples, groups): NaN for
        a group without items."""
        names, codes = np.unique(groups, return_inverse=True)
        member = np.eye(len(names))[codes]
        return names, divide(self._counts @ (member * values[:, None]), self._counts @ member)


def divide(sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return sums / counts in resamples: NaN where nothing was counted."""
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)


def interval_of(value: float, resampled: np.ndarray, n: int) -> Interval:
    """Return a statistic of `n` items, with the interval of its values in resamples."""
    low, high = np.nanpercentile(resampled, [2.5, 97.5])
    return Interval(float(value), float(low), float(high), n)
