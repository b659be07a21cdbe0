import math

import numpy as np
import pytest

from evaluation.metrics.intervals import SceneBootstrap, macro_by_scene, mean_with_wilson
from evaluation.metrics.results import accuracy_by_family
from tests.evaluation.metrics.reference import scene_interval


@pytest.mark.parametrize(("successes", "n"), [(0, 5), (5, 5), (7, 20), (92, 249), (2.5, 10)])
def test_wilson_intervals_equal_the_published_formula(successes, n):
    z, p = 1.959963984540054, successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    found = mean_with_wilson(np.full(n, p))
    assert (found.value, found.n) == (pytest.approx(p), n)
    assert (found.low, found.high) == pytest.approx((centre - half, centre + half), abs=1e-12)


@pytest.mark.parametrize("items", [1, 2, 40, 401])
def test_bootstrap_intervals_equal_those_of_explicit_resampling(items):
    rng = np.random.default_rng(items)
    scenes = [f"scene {k}" for k in rng.integers(max(1, items // 5), size=items)]
    values = np.round(rng.random(items), 2)
    bootstrap = SceneBootstrap(scenes, seed=7, resamples=300)
    intervals = (bootstrap.mean(values), np.mean), (bootstrap.median(values), np.median)
    for found, statistic in intervals:
        resampled = scene_interval(values, scenes, statistic, seed=7, resamples=300)
        assert found == pytest.approx(resampled, abs=1e-12)
        assert found[0] <= statistic(values) <= found[1]


@pytest.mark.parametrize("items", [1, 3, 40, 401])
def test_macro_is_the_mean_of_the_families_means(items):
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
    resampled = scene_interval(table, scenes, macro, seed=7)
    assert (found.low, found.high) == pytest.approx(resampled, abs=1e-12)
    # With a single family, macro is the mean of all items.
    single = macro_by_scene(credits, ["time"] * items, scenes, seed=7)
    assert (single.low, single.high) == pytest.approx(
        scene_interval(credits, scenes, np.mean, seed=7)
    )
