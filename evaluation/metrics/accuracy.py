"""Accuracy, ranks and intervals. Everything is a share between 0 and 1 unless it says otherwise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma

from data.records import FAMILIES


def gold_scores(scores: np.ndarray, gold: np.ndarray) -> np.ndarray:
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


def compare(scores: np.ndarray, gold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def ranks_of(scores: np.ndarray, gold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames strictly above the gold frame, and other frames tied with it: two (queries,) arrays.

    Both are 0 for a query without a gold score; `gold_scores` says which those are (NaN).
    Arguments and errors are those of `gold_scores`.
    """
    greater, equal = compare(scores, gold_scores(scores, gold))
    return greater, np.maximum(equal - 1, 0)


def expected_hits(greater: np.ndarray, tied: np.ndarray, valid: np.ndarray, k: int) -> np.ndarray:
    """Each query's chance (queries,) to be among the first `k` when ties fall at random.

    With k = 1 this is the credit of a similarity scorer on a selection item: 1/m where the right
    candidate is one of m maxima.
    """
    hits = np.clip((k - np.asarray(greater)) / (np.asarray(tied) + 1), 0, 1)
    return np.where(valid, hits, 0.0)


def metrics_from_counts(
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
    each = query_measures(greater, tied, valid, frames, ks)
    return {name: float(summary(name)(values)) for name, values in each.items()}


def query_measures(
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


def rank_metrics(scores: np.ndarray, gold: np.ndarray, ks: Sequence[int]) -> dict[str, float]:
    """`metrics_from_counts` of one score matrix (queries, frames) and its gold columns (queries,).

    A gold column that is negative, NaN or None, or a NaN gold score, is a miss. Scores are compared
    in fp32. Errors are those of `gold_scores`, and ValueError where there is no query.
    """
    valid = ~np.isnan(gold_scores(scores, gold))
    return metrics_from_counts(*ranks_of(scores, gold), valid, np.shape(scores)[1], ks)


@dataclass(frozen=True)
class Interval:
    """A measure of `n` items, such as a share, with its 95% interval."""

    value: float
    low: float
    high: float
    n: int


@dataclass(frozen=True)
class Accuracy:
    """Accuracy by family, in the order event, time, window; a family without items is left out."""

    families: dict[str, Interval]
    macro: float
    micro: Interval


def wilson(successes: float, n: int) -> tuple[float, float]:
    """The 95% Wilson interval of `successes` out of `n`; (0, 1) where n is 0."""
    # Imported here: it takes longer to load than all else that a command needs for its --help.
    from statsmodels.stats.proportion import proportion_confint

    if n == 0:
        return 0.0, 1.0
    low, high = proportion_confint(successes, n, method="wilson")
    return float(low), float(high)


def accuracy_by(groups: Sequence[str], correct: Sequence[float]) -> dict[str, Interval]:
    """Accuracy of each group of items, in order of name.

    Args:
        groups: a name an item: its family, subtype or horizon.
        correct: its credit, a bool or the 1/m of a tie among m.

    Raises:
        ValueError: not one credit an item.
    """
    groups, correct = np.asarray(groups, str), np.asarray(correct, float)
    if groups.shape != correct.shape:
        raise ValueError(f"{len(groups)} groups for {len(correct)} items")
    return {str(g): _interval(correct[groups == g]) for g in np.unique(groups)}


def accuracy_table(families: Sequence[str], correct: Sequence[float]) -> Accuracy:
    """Accuracy by family, their plain mean (macro) over the families present, and over all items
    (micro).

    Raises:
        ValueError: no items, not one credit an item, or a family that does not exist.
    """
    found = accuracy_by(families, correct)
    if not found or set(found) - set(FAMILIES):
        raise ValueError(f"families {sorted(found)}: expected some of {', '.join(FAMILIES)}")
    ordered = {f: found[f] for f in FAMILIES if f in found}
    macro = float(np.mean([i.value for i in ordered.values()]))
    return Accuracy(ordered, macro, _interval(np.asarray(correct, float)))


def _interval(correct: np.ndarray) -> Interval:
    return Interval(
        float(correct.mean()), *wilson(float(correct.sum()), len(correct)), len(correct)
    )


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
