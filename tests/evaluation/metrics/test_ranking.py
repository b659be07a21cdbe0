"""The measures of ranks agree with their definition, in blocks too, and with another library."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest
import pytrec_eval

from dynapix.evaluation.metrics.ranking import count_above_and_equal, rank_metrics, target_scores
from tests.evaluation.metrics.reference import ranking_metrics
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


@pytest.mark.parametrize("block", [1, 7, 30])
def test_blockwise_metrics_equal_those_of_the_full_matrix(block) -> None:
    rng = np.random.default_rng(0)
    scores = rng.integers(6, size=(40, 30)).astype(np.float32)
    target = rng.integers(30, size=40)
    scores[3, 4] = scores[5, target[5]] = np.nan
    of_target = target_scores(scores, target)
    blocks = [scores[:, i : i + block] for i in range(0, 30, block)]
    counts = [count_above_and_equal(columns, of_target) for columns in blocks]
    above = sum(g for g, _ in counts)
    tied = np.maximum(sum(e for _, e in counts) - 1, 0)
    by_frame = ranking_metrics(above, tied, ~np.isnan(of_target), 30, KS)
    assert by_frame == rank_metrics(scores, target, KS)


def test_queries_without_a_target_or_with_nan_are_misses() -> None:
    scores = np.array([[1.0, 0, 0, 0], [1, 0, 0, 0], [np.nan, 1, 1, 1]])
    measured = rank_metrics(scores, [0, -1, 0], (1, 4))
    assert measured["recall@1"] == measured["recall@4"] == pytest.approx(1 / 3)
    assert measured["mrr"] == pytest.approx(1 / 3)
    assert measured["median_rank"] == 4
    # Other frames with NaN rank below the target.
    assert rank_metrics(np.array([[np.nan, 0.5, np.nan]]), [1], (1,))["recall@1"] == 1


def test_scores_are_compared_in_fp32() -> None:
    assert rank_metrics(np.array([[0.5, 0.5 + 1e-12, 0.1]]), [0], (1,))["tie_rate"] == 1


def test_metrics_without_ties_match_pytrec_eval() -> None:
    rng = np.random.default_rng(5)
    scores = rng.permuted(np.tile(np.arange(120.0), (40, 1)), axis=1)
    target = rng.integers(120, size=40)
    run = {f"q{i}": {f"f{j}": s for j, s in enumerate(row)} for i, row in enumerate(scores)}
    relevant = {f"q{i}": {f"f{g}": 1} for i, g in enumerate(target)}
    judge = pytrec_eval.RelevanceEvaluator(relevant, {"recall.1,10,50", "recip_rank"})
    expected = judge.evaluate(run).values()
    metrics = rank_metrics(scores, target, (1, 10, 50))
    for k in (1, 10, 50):
        recall = np.mean([q[f"recall_{k}"] for q in expected])
        assert metrics[f"recall@{k}"] == pytest.approx(recall)
    ranks = np.array([1 / q["recip_rank"] for q in expected])
    assert metrics["mrr"] == pytest.approx((1 / ranks).mean())
    assert metrics["median_rank"] == pytest.approx(np.median(ranks))


@pytest.mark.parametrize(
    ("scores", "gold", "ks", "hint"),
    [
        (np.ones(3), [0], (1,), "(3,)"),
        (np.ones((2, 3)), [0], (1,), "one column per query"),
        (np.ones((2, 0)), [0, 0], (1,), "(2, 0)"),
        (np.ones((1, 3)), [3], (1,), "below 3"),
        (np.ones((1, 3)), [0.0], (1,), "whole numbers"),
        (np.ones((1, 3)), [0], (), "1 or more"),
        (np.ones((1, 3)), [0], ["a"], "whole numbers"),
        (np.ones((1, 3)), [0], (1.5,), "whole numbers"),
        ([[10**400, 0]], [0], (1,), "not arrays of numbers"),
    ],
)
def test_invalid_arguments_are_refused(scores, gold, ks, hint) -> None:
    with raises_user_error("invalid-scores", contains=hint):
        rank_metrics(scores, gold, ks)


@pytest.mark.parametrize("ks", [2, np.array([2])])
def test_cut_offs_may_be_a_number_or_an_array(ks) -> None:
    assert rank_metrics(np.array([[0.1, 0.2]]), [0], ks)["recall@2"] == 1
