"""dynapix.rank_metrics agrees with its definition, and refuses invalid arguments."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest

from dynapix.evaluation.metrics.ranking import rank_metrics
from tests.user_errors import raises_user_error

KS = (1, 2, 5)


def metrics_over_orders(scores: np.ndarray, target: int) -> dict[str, float]:
    """The measures of a query as means over all orders of the frames that respect the scores."""
    orders = [
        order
        for order in permutations(range(len(scores)))
        if all(scores[a] >= scores[b] for a, b in pairwise(order))
    ]
    ranks = np.array([order.index(target) + 1 for order in orders])
    recalls = {f"recall@{k}": (ranks <= k).mean() for k in KS}
    return {**recalls, "mrr": (1 / ranks).mean(), "median_rank": ranks.mean()}


def test_a_query_has_the_mean_over_all_orders_of_tied_frames() -> None:
    rng = np.random.default_rng(0)
    for _ in range(40):
        scores, target = rng.integers(0, 3, 6).astype(float), int(rng.integers(6))
        expected = metrics_over_orders(scores, target)
        expected["tie_rate"] = float((scores == scores[target]).sum() > 1)
        assert rank_metrics(scores[None], [target], KS) == pytest.approx(expected)


def test_measures_are_means_over_the_queries_and_the_median_of_ranks() -> None:
    scores = np.array([[3.0, 2, 1], [3, 2, 1], [3, 2, 1]])
    measured = rank_metrics(scores, [0, 1, 2], (1, 2))
    expected = {"recall@1": 1 / 3, "recall@2": 2 / 3, "mrr": (1 + 1 / 2 + 1 / 3) / 3}
    assert measured == pytest.approx({**expected, "median_rank": 2, "tie_rate": 0})


def test_queries_without_a_target_or_with_nan_are_misses() -> None:
    scores = np.array([[1.0, 0, 0, 0], [1, 0, 0, 0], [np.nan, 1, 1, 1]])
    measured = rank_metrics(scores, [0, -1, 0], (1, 4))
    assert measured["recall@1"] == measured["recall@4"] == pytest.approx(1 / 3)
    assert measured["mrr"] == pytest.approx(1 / 3)
    assert measured["median_rank"] == 4


def test_other_frames_with_nan_rank_below_the_target() -> None:
    assert rank_metrics(np.array([[np.nan, 0.5, np.nan]]), [1], (1,))["recall@1"] == 1


@pytest.mark.parametrize(
    ("scores", "gold", "ks", "hint"),
    [
        (np.ones(3), [0], (1,), "(3,)"),
        (np.ones((2, 3)), [0], (1,), "one column per query"),
        (np.ones((2, 0)), [0, 0], (1,), "(2, 0)"),
        (np.ones((1, 3)), [3], (1,), "below 3"),
        (np.ones((1, 3)), [0.0], (1,), "whole numbers"),
        (np.ones((1, 3)), [0], (0,), "1 or more"),
        (np.ones((1, 3)), [0], (), "1 or more"),
    ],
)
def test_invalid_arguments_are_refused(scores, gold, ks, hint) -> None:
    with raises_user_error("invalid-scores", contains=hint):
        rank_metrics(scores, gold, ks)
