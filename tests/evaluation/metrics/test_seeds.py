"""Accuracies over seeds: means, and intervals that agree with explicit resampling."""

from __future__ import annotations

import numpy as np
import pytest

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.evaluation.metrics.seeds import SeedBootstrap

FAMILIES = np.array(["event", "time", "window"] * 40)
SCENES = np.repeat([f"s{k}" for k in range(30)], 4)


def draw(rng: np.random.Generator, seeds: int) -> np.ndarray:
    """Credits with an effect of the scene and of the seed."""
    chance = 0.5 + 0.3 * rng.standard_normal(30)[np.unique(SCENES, return_inverse=True)[1]]
    effects = 0.2 * rng.standard_normal(seeds)
    return (rng.random((len(SCENES), seeds)) < chance[:, None] + effects).astype(float)


def test_accuracies_are_means_over_items_and_seeds() -> None:
    credits = draw(np.random.default_rng(0), 3)
    found = SeedBootstrap(FAMILIES, SCENES).accuracies("cot", credits)
    means = {name: credits[name == FAMILIES].mean() for name in ("event", "time", "window")}
    assert {name: each.value for name, each in found.items()} == pytest.approx(
        {**means, "macro": np.mean([*means.values()])}
    )
    assert [each.n for each in found.values()] == [40, 40, 40, 120]


def test_intervals_equal_those_of_explicit_resampling() -> None:
    rng = np.random.default_rng(1)
    credits = draw(rng, 3)
    found = SeedBootstrap(FAMILIES, SCENES).accuracies("cot", credits)["macro"]
    names, codes = np.unique(SCENES, return_inverse=True)
    rows = [np.flatnonzero(codes == k) for k in range(len(names))]
    draws = []
    for _ in range(4000):
        items = np.concatenate([rows[k] for k in rng.integers(len(names), size=len(names))])
        seeds = rng.integers(3, size=3)
        picked = credits[items][:, seeds]
        draws.append(np.mean([picked[FAMILIES[items] == f].mean() for f in set(FAMILIES)]))
    low, high = np.percentile(draws, [2.5, 97.5])
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


def test_one_seed_has_the_interval_over_scenes() -> None:
    credits = draw(np.random.default_rng(2), 1)
    found = SeedBootstrap(FAMILIES, SCENES).accuracies("cot", credits)["macro"]
    scenes = SceneBootstrap(SCENES, 0).macro(credits[:, 0], FAMILIES)
    assert (found.low, found.high) == pytest.approx((scenes.low, scenes.high), abs=0.01)
    # Equal seeds add nothing.
    same = SeedBootstrap(FAMILIES, SCENES).accuracies("cot", np.repeat(credits, 4, axis=1))["macro"]
    assert (same.low, same.high) == pytest.approx((found.low, found.high))


def test_seeds_of_other_trainings_widen_a_difference() -> None:
    rng = np.random.default_rng(3)
    credits = draw(rng, 3)
    seeds = SeedBootstrap(FAMILIES, SCENES)
    same = seeds.differences(("cot", credits), ("cot", credits))["macro"]
    assert (same.value, same.low, same.high) == (0, 0, 0)
    other = seeds.differences(("cot", credits), ("other", credits))["macro"]
    assert other.value == 0
    assert other.low < 0 < other.high


def test_families_without_items_are_left_out() -> None:
    found = SeedBootstrap(["time"] * 4, ["a", "a", "b", "b"]).accuracies("cot", np.eye(4))
    assert [*found] == ["time", "macro"]
    assert found["time"] == found["macro"]
