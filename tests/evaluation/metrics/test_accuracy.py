import math
from itertools import permutations

import numpy as np
import pytest
import pytrec_eval
import torch

from evaluation.metrics.accuracy import accuracy_by_family, accuracy_by_group
from evaluation.metrics.intervals import SceneBootstrap, macro_by_scene, wilson_interval
from evaluation.metrics.ranking import (
    count_above_and_equal,
    count_ranks,
    expected_hits,
    ranking_metrics,
    ranking_metrics_of_scores,
    target_scores,
)
from tests.evaluation.metrics.resampled import interval

KS = (1, 2, 3, 10)


def tied_scores(queries=40, frames=30, levels=6, seed=0):
    rng = np.random.default_rng(seed)
    scores = rng.integers(levels, size=(queries, frames)).astype(np.float32)
    return scores, rng.integers(frames, size=queries)


def enumerated(row, gold, ks):
    """Means of one query's metrics over every order that ties can fall in."""
    orders = [
        sorted(range(len(row)), key=lambda i, order=order: (-row[i], order[i]))
        for order in permutations(range(len(row)))
    ]
    ranks = np.array([order.index(gold) + 1 for order in orders])
    recalls = {f"recall@{k}": (ranks <= k).mean() for k in ks}
    return {**recalls, "mrr": (1 / ranks).mean(), "median_rank": ranks.mean()}


def test_ties_are_the_mean_over_every_order():
    rng = np.random.default_rng(0)
    for _ in range(12):
        row, gold = rng.integers(3, size=6), int(rng.integers(6))
        found = ranking_metrics_of_scores(row[None], np.array([gold]), KS)
        for key, value in enumerated(row, gold, KS).items():
            assert found[key] == pytest.approx(value)


def test_without_ties_it_is_sorting():
    rng = np.random.default_rng(1)
    scores = rng.permuted(np.tile(np.arange(50.0), (30, 1)), axis=1)
    gold = rng.integers(50, size=30)
    ranks = np.array([list(np.argsort(-s)).index(g) + 1 for s, g in zip(scores, gold, strict=True)])
    found = ranking_metrics_of_scores(scores, gold, KS)
    assert found["mrr"] == pytest.approx((1 / ranks).mean())
    assert found["median_rank"] == np.median(ranks)
    assert found["tie_rate"] == 0
    for k in KS:
        assert found[f"recall@{k}"] == pytest.approx((ranks <= k).mean())


def test_a_constant_scorer_gets_chance():
    found = ranking_metrics_of_scores(np.zeros((5, 200)), np.arange(5), KS)
    for k in KS:
        assert found[f"recall@{k}"] == pytest.approx(k / 200)
    assert found["mrr"] == pytest.approx(sum(1 / i for i in range(1, 201)) / 200)
    assert found["median_rank"] == 100.5
    assert found["tie_rate"] == 1


def test_order_of_frames_and_queries_does_not_matter():
    scores, gold = tied_scores()
    columns = np.random.default_rng(2).permutation(scores.shape[1])
    rows = np.random.default_rng(3).permutation(len(gold))
    shuffled = scores[rows][:, columns]
    moved = np.argsort(columns)[gold[rows]]
    assert ranking_metrics_of_scores(shuffled, moved, KS) == pytest.approx(
        ranking_metrics_of_scores(scores, gold, KS)
    )


@pytest.mark.parametrize("block", [1, 7, 30])
def test_blocks_of_frames_and_queries_equal_the_whole(block):
    scores, gold = tied_scores()
    scores[3, 4] = np.nan
    gold[5] = -1
    own = target_scores(scores, gold)
    counts = [count_above_and_equal(scores[:, i : i + block], own) for i in range(0, 30, block)]
    greater = sum(g for g, _ in counts)
    tied = np.maximum(sum(e for _, e in counts) - 1, 0)
    by_frame = ranking_metrics(greater, tied, ~np.isnan(own), 30, KS)
    parts = [count_ranks(scores[i : i + block], gold[i : i + block]) for i in range(0, 40, block)]
    by_query = ranking_metrics(*map(np.concatenate, zip(*parts, strict=True)), gold >= 0, 30, KS)
    assert by_frame == by_query == ranking_metrics_of_scores(scores, gold, KS)


def test_nan_and_missing_queries_are_misses_that_count():
    scores = np.array([[3.0, 2, 1], [np.nan, 2, 1], [3, 2, 1], [np.nan, 2, np.nan]])
    found = ranking_metrics_of_scores(scores, np.array([0, 0, -1, 1]), [1, 3])
    assert found == {
        "recall@1": 0.5,
        "recall@3": 0.5,
        "mrr": 0.5,
        "median_rank": 2.0,
        "tie_rate": 0.0,
    }


def test_all_nan_scores_tie_with_nothing():
    found = ranking_metrics_of_scores(np.full((2, 4), np.nan), np.array([0, 1]), [1])
    assert found == {"recall@1": 0.0, "mrr": 0.0, "median_rank": 4.0, "tie_rate": 0.0}


@pytest.mark.parametrize("missing", [-1, np.nan, None])
def test_a_missing_query_is_a_miss_however_it_is_told(missing):
    scores = [[0.5, 0.1], [0.5, 0.1]]
    found = ranking_metrics_of_scores(scores, [0, missing], [1])
    assert found == ranking_metrics_of_scores(scores, np.array([0, -1]), [1])
    assert found["recall@1"] == found["mrr"] == 0.5
    # Nor is there a frame to find in an empty database.
    assert ranking_metrics_of_scores(np.zeros((1, 0)), [missing], [1])["recall@1"] == 0


@pytest.mark.parametrize("gold", [[0.5, 1], [True, False], [np.inf, 0]])
def test_a_column_that_is_no_number_of_one_is_refused(gold):
    with pytest.raises(ValueError, match="whole numbers"):
        ranking_metrics_of_scores(np.zeros((2, 3)), gold, [1])


def test_scores_are_compared_in_fp32():
    scores = np.array([[0.5, 0.5 + 1e-12, 0.1]])
    assert ranking_metrics_of_scores(scores, np.array([0]), [1])["tie_rate"] == 1


def test_tensors_are_read():
    scores, gold = tied_scores()
    tensors = ranking_metrics_of_scores(torch.from_numpy(scores), torch.from_numpy(gold), KS)
    assert tensors == ranking_metrics_of_scores(scores, gold, KS)


@pytest.mark.parametrize(
    ("shape", "gold"),
    [((2, 3), [0]), ((2, 3), [0, 3]), ((3,), [0, 1, 2]), ((0, 3), []), ((0,), [])],
)
def test_wrong_shapes_are_refused(shape, gold):
    with pytest.raises(ValueError, match=r"expected|past|no queries"):
        ranking_metrics_of_scores(np.zeros(shape), gold, KS)


def test_credit_of_four_candidates():
    scores = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1], [0, 1, 1, 0], [np.nan, 0, 0, 0]])
    answer = np.zeros(5, int)
    valid = ~np.isnan(target_scores(scores, answer))
    credit = expected_hits(*count_ranks(scores, answer), valid, 1)
    assert credit.tolist() == [1, 0.5, 0.25, 0, 0]


def test_ranks_without_ties_are_those_of_an_independent_library():
    rng = np.random.default_rng(5)
    scores = rng.permuted(np.tile(np.arange(120.0), (40, 1)), axis=1)
    gold = rng.integers(120, size=40)
    run = {f"q{i}": {f"f{j}": s for j, s in enumerate(row)} for i, row in enumerate(scores)}
    asked = {f"q{i}": {f"f{g}": 1} for i, g in enumerate(gold)}
    judge = pytrec_eval.RelevanceEvaluator(asked, {"recall.1,10,50", "recip_rank"})
    expected = judge.evaluate(run).values()
    found = ranking_metrics_of_scores(scores, gold, (1, 10, 50))
    for k in (1, 10, 50):
        assert found[f"recall@{k}"] == pytest.approx(np.mean([q[f"recall_{k}"] for q in expected]))
    ranks = np.array([1 / q["recip_rank"] for q in expected])
    assert found["mrr"] == pytest.approx((1 / ranks).mean())
    assert found["median_rank"] == pytest.approx(np.median(ranks))


@pytest.mark.parametrize(("successes", "n"), [(0, 5), (5, 5), (7, 20), (92, 249), (2.5, 10)])
def test_wilson_is_its_formula(successes, n):
    z, p = 1.959963984540054, successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert wilson_interval(successes, n) == pytest.approx((centre - half, centre + half), abs=1e-12)


def test_wilson_of_nothing_is_everything():
    assert wilson_interval(0, 0) == (0, 1)


def test_accuracy_by_family():
    families = ["time", "event", "window", "window", "window", "event"]
    found = accuracy_by_family(families, [0, 1, True, True, 0.5, 0])
    assert list(found.families) == ["event", "time", "window"]
    assert [i.value for i in found.families.values()] == pytest.approx([1 / 2, 0, 2.5 / 3])
    assert [i.n for i in found.families.values()] == [2, 1, 3]
    assert found.macro == pytest.approx((1 / 2 + 2.5 / 3) / 3)
    assert (found.micro.value, found.micro.n) == (pytest.approx(3.5 / 6), 6)
    assert (found.micro.low, found.micro.high) == wilson_interval(3.5, 6)


def test_macro_is_over_the_families_present():
    assert accuracy_by_family(["time", "event"], [1, 0]).macro == 0.5


def test_groups_of_any_name():
    found = accuracy_by_group(["b", "a", "b"], [1, 1, 0])
    assert {k: (v.value, v.n) for k, v in found.items()} == {"a": (1, 1), "b": (0.5, 2)}


@pytest.mark.parametrize(
    ("families", "correct"), [([], []), (["event"], [1, 0]), (["motion"], [1])]
)
def test_wrong_tables_are_refused(families, correct):
    with pytest.raises(ValueError, match=r"families|groups"):
        accuracy_by_family(families, correct)


def test_bootstrap_draws_whole_scenes():
    rng = np.random.default_rng(0)
    alone = rng.random(400)
    spread = SceneBootstrap(np.arange(400), seed=1).mean(alone)
    half = 1.96 * alone.std() / 20
    assert spread == pytest.approx((alone.mean() - half, alone.mean() + half), abs=0.01)
    # Twenty-five copies of 16 values say no more than the 16: a scene is drawn or it is not.
    few, scenes = np.repeat(rng.random(16), 25), np.repeat(np.arange(16), 25)
    low, high = SceneBootstrap(scenes, seed=1).mean(few)
    assert high - low > 4 * (spread[1] - spread[0]) * 0.7


def test_bootstrap_of_nothing_is_refused():
    with pytest.raises(ValueError, match="no items"):
        SceneBootstrap([], seed=0)


@pytest.mark.parametrize("items", [1, 2, 40, 401])
def test_many_measures_at_once_draw_what_one_does(items):
    rng = np.random.default_rng(items)
    scenes = [f"scene {k}" for k in rng.integers(max(1, items // 5), size=items)]
    values = np.round(rng.random(items), 2)
    once = SceneBootstrap(scenes, seed=7, resamples=300)
    for found, statistic in ((once.mean(values), np.mean), (once.median(values), np.median)):
        drawn = interval(values, scenes, statistic, seed=7, resamples=300)
        assert found == pytest.approx(drawn, abs=1e-12)
        assert found[0] <= statistic(values) <= found[1]


@pytest.mark.parametrize("items", [1, 3, 40, 401])
def test_a_macro_is_the_mean_of_its_families_means(items):
    rng = np.random.default_rng(items)
    scenes = [f"scene {k}" for k in rng.integers(max(1, items // 5), size=items)]
    families = rng.choice(["event", "time", "window"], size=items, p=[0.1, 0.2, 0.7])
    credits = rng.integers(2, size=items)

    def macro(rows):
        return np.mean([rows[rows[:, 0] == f, 1].astype(float).mean() for f in set(rows[:, 0])])

    found = macro_by_scene(credits, families, scenes, seed=7)
    assert found.value == pytest.approx(accuracy_by_family(families, credits).macro)
    assert found.n == items
    table = np.stack([families, credits.astype(str)], axis=1)
    drawn = interval(table, scenes, macro, seed=7)
    assert (found.low, found.high) == pytest.approx(drawn, abs=1e-12)
    # Of one family it is the mean.
    alone = macro_by_scene(credits, ["time"] * items, scenes, seed=7)
    assert (alone.low, alone.high) == pytest.approx(interval(credits, scenes, np.mean, seed=7))


def test_a_macro_of_parts_that_do_not_fit_is_refused():
    with pytest.raises(ValueError, match="values for"):
        macro_by_scene([1, 0], ["event"], ["a", "b"], seed=0)
    with pytest.raises(ValueError, match="no items"):
        macro_by_scene([], [], [], seed=0)


def test_many_measures_of_nothing_are_refused():
    with pytest.raises(ValueError, match="no items"):
        SceneBootstrap([], seed=0)
