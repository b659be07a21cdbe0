"""95% intervals of shares, means and medians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Interval:
    """A measure of `n` items, such as a share, with its 95% interval."""

    value: float
    low: float
    high: float
    n: int


def wilson_interval(successes: float, n: int) -> tuple[float, float]:
    """The 95% Wilson interval of `successes` out of `n`; (0, 1) where n is 0."""
    # Imported here: it takes longer to load than all else that a command needs for its --help.
    from statsmodels.stats.proportion import proportion_confint

    if n == 0:
        return 0.0, 1.0
    low, high = proportion_confint(successes, n, method="wilson")
    return float(low), float(high)


class SceneBootstrap:
    """95% percentile intervals of means and medians when whole scenes are drawn again: items of one
    scene share its video, so drawing items would call a result surer than it is. For many measures
    of the same items: what is drawn is how often each item counts, and nothing is copied."""

    def __init__(self, scenes: Sequence[str], seed: int, resamples: int = 2000) -> None:
        """`scenes` names the scene of each item.

        Raises:
            ValueError: no items.
        """
        _, codes = np.unique(np.asarray(scenes), return_inverse=True)
        if not len(codes):
            raise ValueError("no items to draw from")
        count = codes.max() + 1
        drawn = np.random.default_rng(seed).integers(count, size=(resamples, count))
        cells = drawn + count * np.arange(resamples)[:, None]
        times = np.bincount(cells.ravel(), minlength=drawn.size).reshape(drawn.shape)
        self._times = times.astype(np.int32)[:, codes]

    def mean(self, values: np.ndarray) -> np.ndarray:
        """The 95% interval (2,), low and high, of the mean of values (items,)."""
        return _middle(self._times @ values / self._times.sum(1))

    def median(self, values: np.ndarray) -> np.ndarray:
        """The 95% interval (2,) of the median of values (items,)."""
        order = np.argsort(values, kind="stable")
        reached = np.cumsum(self._times[:, order], axis=1, dtype=np.int32)
        total = reached[:, -1:]
        # Of an even number of items the median is the mean of the middle two.
        middle = [(reached > place).argmax(1) for place in ((total - 1) // 2, total // 2)]
        return _middle(np.asarray(values, float)[order][middle].mean(0))

    def macro(self, values: np.ndarray, groups: Sequence[str]) -> np.ndarray:
        """The 95% interval (2,) of the mean of the groups' means of values (items,); a group that a
        draw lacks is left out of that draw's mean."""
        _, codes = np.unique(np.asarray(groups), return_inverse=True)
        member = np.eye(codes.max() + 1)[codes]
        sums, counts = self._times @ (member * values[:, None]), self._times @ member
        means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
        return _middle(np.nanmean(means, axis=1))


def macro_by_scene(
    values: Sequence[float], groups: Sequence[str], scenes: Sequence[str], seed: int
) -> Interval:
    """The plain mean of the groups' means, with its 95% interval when whole scenes are drawn again:
    of credits by family a macro accuracy, of differences of credits what two macros are apart, and
    of one group its mean.

    Args:
        values: a number an item.
        groups, scenes: a name an item.

    Raises:
        ValueError: no items, or not one group and one scene an item.
    """
    values, groups = np.asarray(values, float), np.asarray(groups)
    if not len(values) == len(groups) == len(scenes):
        raise ValueError(f"{len(values)} values for {len(groups)} groups, {len(scenes)} scenes")
    low, high = SceneBootstrap(scenes, seed).macro(values, groups)
    mean = np.mean([values[groups == g].mean() for g in np.unique(groups)])
    return Interval(float(mean), float(low), float(high), len(values))


def _middle(results: np.ndarray) -> np.ndarray:
    return np.percentile(results, [2.5, 97.5])
