import numpy as np
import pytest

from dynapix.data.checks.intervals import SceneBootstrap
from tests.evaluation.metrics.reference import scene_interval


@pytest.mark.parametrize("items", [1, 2, 40, 401])
def test_bootstrap_intervals_equal_those_of_explicit_resampling(items):
    rng = np.random.default_rng(items)
    scenes = [f"scene {k}" for k in rng.integers(max(1, items // 5), size=items)]
    values = np.round(rng.random(items), 2)
    bootstrap = SceneBootstrap(scenes, seed=7, resamples=300)
    intervals = (bootstrap.mean(values), np.mean), (bootstrap.median(values), np.median)
    for found, statistic in intervals:
        resampled = scene_interval(values, scenes, statistic, seed=7, resamples=300)
        assert (found.low, found.high) == pytest.approx(resampled, abs=1e-12)
        assert found.value == pytest.approx(statistic(values))
        assert found.low <= found.value <= found.high
        assert found.n == items


@pytest.mark.parametrize("items", [1, 3, 40, 401])
def test_macro_is_the_mean_of_the_families_means(items):
    rng = np.random.default_rng(items)
    scenes = [f"scene {k}" for k in rng.integers(max(1, items // 5), size=items)]
    families = rng.choice(["event", "time", "window"], size=items, p=[0.1, 0.2, 0.7])
    credits = rng.integers(2, size=items)

    def macro(rows):
        return np.mean([rows[rows[:, 0] == f, 1].astype(float).mean() for f in set(rows[:, 0])])

    bootstrap = SceneBootstrap(scenes, seed=7)
    found = bootstrap.macro(credits, families)
    means = bootstrap.group_means(credits, families)
    assert found.value == pytest.approx(np.mean([mean.value for mean in means.values()]))
    assert found.n == items
    table = np.stack([families, credits.astype(str)], axis=1)
    resampled = scene_interval(table, scenes, macro, seed=7)
    assert (found.low, found.high) == pytest.approx(resampled, abs=1e-12)
    # With a single family, macro is the mean of all items.
    single = bootstrap.macro(credits, ["time"] * items)
    assert (single.low, single.high) == pytest.approx(
        scene_interval(credits, scenes, np.mean, seed=7)
    )


def test_intervals_of_group_means_equal_those_of_explicit_resampling():
    rng = np.random.default_rng(5)
    scenes = np.array([f"scene {k}" for k in rng.integers(12, size=200)])
    groups = rng.choice(["b", "a"], size=200, p=[0.97, 0.03])
    credits = rng.integers(2, size=200).astype(float)
    found = SceneBootstrap(scenes, seed=7).group_means(credits, groups)
    assert list(found) == ["a", "b"]
    for name, interval in found.items():
        own = groups == name
        assert (interval.value, interval.n) == (pytest.approx(credits[own].mean()), own.sum())
        # A resample without an item of the group has no mean.
        table = np.stack([credits, own], axis=1)
        picked = [np.flatnonzero(scenes == scene) for scene in np.unique(scenes)]
        sampled = np.random.default_rng(7).integers(len(picked), size=(2000, len(picked)))
        rows = [table[np.concatenate([picked[i] for i in picks])] for picks in sampled]
        means = [part[part[:, 1] == 1, 0].mean() for part in rows if part[:, 1].any()]
        assert (interval.low, interval.high) == pytest.approx(np.percentile(means, [2.5, 97.5]))
