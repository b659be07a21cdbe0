"""Accuracies of a training with several seeds, with intervals over scenes and seeds."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from dynapix.data.checks.intervals import Interval, divide, interval_of
from dynapix.data.records import FAMILIES

MACRO = "macro"
"""Name of the unweighted mean of the families' accuracies."""
DRAWS = 4000
"""Number of bootstrap samples."""


class SeedBootstrap:
    """95% percentile intervals of a bootstrap over scenes and seeds, for accuracies by family.

    All results share the resampled scenes, and those of the same trainings the resampled seeds. The
    seeds of different trainings are resampled independently, since two trainings with the same seed
    have nothing in common but its number.

    Args:
        families: The family of each item.
        scenes: The scene of each item, which is resampled with all of its items.
        order: The families of the result, in order; those without items are left out.
    """

    def __init__(
        self, families: Sequence[str], scenes: Sequence[str], order: Sequence[str] = FAMILIES
    ) -> None:
        families = np.asarray(families, str)
        names, self._scene = np.unique(np.asarray(scenes, str), return_inverse=True)
        self._members = {name: families == name for name in order if (families == name).any()}
        share = np.full(len(names), 1 / len(names))
        # (draws, scenes) how often each draw contains each scene.
        weights = np.random.default_rng(0).multinomial(len(names), share, size=DRAWS)
        self._weights = weights.astype(float)

    def accuracies(self, training: str, credits: np.ndarray) -> dict[str, Interval]:
        """Return the mean over all seeds by family, and the macro.

        Args:
            training: Name of the training, which determines its resampled seeds.
            credits: (items, seeds), 1 for a right answer.
        """
        return self._summarize(self._means(credits), self._draws(training, credits))

    def differences(
        self, first: tuple[str, np.ndarray], second: tuple[str, np.ndarray]
    ) -> dict[str, Interval]:
        """Return the accuracies of `first` less those of `second`; both are a training and its
        credits."""
        (_, one), (_, other) = first, second
        means, draws = self._means(one) - self._means(other), self._draws(*first)
        return self._summarize(means, draws - self._draws(*second))

    def _summarize(self, means: np.ndarray, draws: np.ndarray) -> dict[str, Interval]:
        counts = [int(members.sum()) for members in self._members.values()]
        columns = zip(means, draws.T, [*counts, sum(counts)], strict=True)
        intervals = (interval_of(*column) for column in columns)
        return dict(zip((*self._members, MACRO), intervals, strict=True))

    def _means(self, credits: np.ndarray) -> np.ndarray:
        means = [credits[members].mean() for members in self._members.values()]
        return np.array([*means, np.mean(means)])

    def _draws(self, training: str, credits: np.ndarray) -> np.ndarray:
        """Return the means of each draw, (draws, families + 1)."""
        seeds = credits.shape[1]
        rng = np.random.default_rng([0, zlib.crc32(training.encode())])
        seed_shares = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=DRAWS) / seeds
        means = []
        for members in self._members.values():
            sums = np.zeros((self._weights.shape[1], seeds))
            np.add.at(sums, self._scene[members], credits[members])
            counts = self._weights @ np.bincount(self._scene[members], minlength=len(sums))
            totals = ((self._weights @ sums) * seed_shares).sum(axis=1)
            means.append(divide(totals, counts))
        return np.column_stack([*means, np.nanmean(means, axis=0)])
