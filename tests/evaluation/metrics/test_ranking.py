from itertools import permutations

import numpy as np
import pytest
import pytrec_eval

from dynapix.evaluation.metrics.ranking import count_above_and_equal, target_scores
from tests.evaluation.metrics.reference import count_ranks, matrix_metrics, ranking_metrics

KS = (1, 2, 3, 10)


def tied_scores(queries=40, frames=30, levels=6, seed=0):
    """Return random scores with many ties, and the column of each query's target."""
    rng = np.random.default_rng(seed)
    scores = rng.integers(levels, size=(queries, frames)).astype(np.float32)
    return scores, rng.integers(frames, size=queries)


def metrics_by_enumeration(row, target, ks):
    """Return the metrics of one query, averaged over every order of the tied frames."""
    orders = [
        sorted(range(len(row)), key=lambda i, order=order: (-row[i], order[i]))
        for order in permutations(range(len(row)))
    ]
    ranks = np.array([order.index(target) + 1 for order in orders])
    recalls = {f"recall@{k}": (ranks <= k).mean() for k in ks}
    return {**recalls, "mrr": (1 / ranks).mean(), "median_rank": ranks.mean()}


def test_metrics_with_ties_are_averaged_over_all_orders():
    rng = np.random.default_rng(0)
    for _ in range(12):
        row, target = rng.integers(3, size=6), int(rng.integers(6))
        metrics = matrix_metrics(row[None], np.array([target]), KS)
        for key, value in metrics_by_enumeration(row, target, KS).items():
            assert metrics[key] == pytest.approx(value)


def test_constant_scores_give_chance_accuracy():
    metrics = matrix_metrics(np.zeros((5, 200)), np.arange(5), KS)
    for k in KS:
        assert metrics[f"recall@{k}"] == pytest.approx(k / 200)
    assert metrics["mrr"] == pytest.approx(sum(1 / i for i in range(1, 201)) / 200)
    assert metrics["median_rank"] == 100.5
    assert metrics["tie_rate"] == 1


def test_metrics_do_not_depend_on_the_order_of_frames_and_queries():
    scores, target = tied_scores()
    columns = np.random.default_rng(2).permutation(scores.shape[1])
    rows = np.random.default_rng(3).permutation(len(target))
    shuffled = scores[rows][:, columns]
    moved = np.argsort(columns)[target[rows]]
    assert matrix_metrics(shuffled, moved, KS) == pytest.approx(matrix_metrics(scores, target, KS))


@pytest.mark.parametrize("block", [1, 7, 30])
def test_blockwise_metrics_equal_those_of_the_full_matrix(block):
    scores, target = tied_scores()
    scores[3, 4] = scores[5, target[5]] = np.nan
    of_target = target_scores(scores, target)
    blocks = [scores[:, i : i + block] for i in range(0, 30, block)]
    counts = [count_above_and_equal(columns, of_target) for columns in blocks]
    above = sum(g for g, _ in counts)
    tied = np.maximum(sum(e for _, e in counts) - 1, 0)
    valid = ~np.isnan(of_target)
    by_frame = ranking_metrics(above, tied, valid, 30, KS)
    parts = [count_ranks(scores[i : i + block], target[i : i + block]) for i in range(0, 40, block)]
    by_query = ranking_metrics(*map(np.concatenate, zip(*parts, strict=True)), valid, 30, KS)
    assert by_frame == by_query == matrix_metrics(scores, target, KS)


def test_queries_with_nan_target_scores_count_as_misses():
    scores = np.array([[3.0, 2, 1], [np.nan, 2, 1], [np.nan, 2, 3], [np.nan, 2, np.nan]])
    metrics = matrix_metrics(scores, np.array([0, 0, 0, 1]), [1, 3])
    expected = {"recall@1": 0.5, "recall@3": 0.5, "mrr": 0.5, "median_rank": 2, "tie_rate": 0}
    assert metrics == expected
    metrics = matrix_metrics(np.full((2, 4), np.nan), np.array([0, 1]), [1])
    assert metrics == {"recall@1": 0, "mrr": 0, "median_rank": 4, "tie_rate": 0}


def test_scores_are_compared_in_fp32():
    scores = np.array([[0.5, 0.5 + 1e-12, 0.1]])
    assert matrix_metrics(scores, np.array([0]), [1])["tie_rate"] == 1


def test_metrics_without_ties_match_pytrec_eval():
    rng = np.random.default_rng(5)
    scores = rng.permuted(np.tile(np.arange(120.0), (40, 1)), axis=1)
    target = rng.integers(120, size=40)
    run = {f"q{i}": {f"f{j}": s for j, s in enumerate(row)} for i, row in enumerate(scores)}
    relevant = {f"q{i}": {f"f{g}": 1} for i, g in enumerate(target)}
    judge = pytrec_eval.RelevanceEvaluator(relevant, {"recall.1,10,50", "recip_rank"})
    expected = judge.evaluate(run).values()
    metrics = matrix_metrics(scores, target, (1, 10, 50))
    for k in (1, 10, 50):
        assert metrics[f"recall@{k}"] == pytest.approx(
            np.mean([q[f"recall_{k}"] for q in expected])
        )
    ranks = np.array([1 / q["recip_rank"] for q in expected])
    assert metrics["mrr"] == pytest.approx((1 / ranks).mean())
    assert metrics["median_rank"] == pytest.approx(np.median(ranks))
