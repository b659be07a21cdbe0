"""Alternative futures of scenes: they branch from the recorded states, and are exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynapix.data.items.futures.simulation import (
    MOVING,
    alternative_scene,
    branches_of_velocities,
    joint_groups,
    moving_objects,
    sample_velocities,
    simulate_futures,
)
from dynapix.data.records import Scene
from dynapix.data.sim.physics import shared_simulator
from tests.data.simulated import CLEVRER, simulate_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate_scene(0, 3)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def single_groups(scene: Scene, frame: int) -> list[tuple[int, ...]]:
    """Each moving object as a group of its own."""
    return [(k,) for k in moving_objects(scene, frame, range(len(scene.objects)))]


def simulate(scene: Scene, frame: int, last: int, velocities: np.ndarray) -> np.ndarray:
    """The states (K, F, N, 13) of futures with these velocities."""
    branches = branches_of_velocities(scene, frame, velocities)
    motions = simulate_futures(scene, frame, last, branches, CLEVRER)
    return np.stack([motion.states for motion in motions])


def test_branch_with_the_true_velocities_continues_the_scene(scene: Scene) -> None:
    true = np.concatenate([scene.velocities[40], scene.angular_velocities[40]], axis=-1)
    (states,) = simulate(scene, 40, 70, true[None].astype(float))
    np.testing.assert_allclose(states[:, :, :3], scene.positions[40:71], atol=0.01)


def test_futures_do_not_depend_on_earlier_simulations(scene: Scene) -> None:
    velocities = sample_velocities(scene, 40, single_groups(scene, 40), 4, 1, rng())
    first = simulate(scene, 40, 60, velocities)
    simulate_scene(0, 5)
    np.testing.assert_array_equal(simulate(scene, 40, 60, velocities), first)
    shared_simulator.cache_clear()
    np.testing.assert_array_equal(simulate(scene, 40, 60, velocities), first)


def test_alternative_scene_joins_past_and_future(scene: Scene) -> None:
    velocities = sample_velocities(scene, 50, single_groups(scene, 50), 1, 0, rng())
    (states,) = simulate(scene, 50, 64, velocities)
    other = alternative_scene(scene, "other", 50, states, CLEVRER)
    assert other.frames == 65
    np.testing.assert_array_equal(other.positions[:51], scene.positions[:51])
    np.testing.assert_allclose(other.positions[50:], states[:, :, :3], atol=1e-6)


@pytest.mark.parametrize("quarter", range(4))
def test_true_speed_lies_in_its_quarter_of_all_speeds(scene: Scene, quarter: int) -> None:
    random = rng()
    group, *_ = single_groups(scene, 40)
    true = np.linalg.norm(scene.velocities[40, group[0], :2])
    assert true > MOVING
    lower = []
    for _ in range(40):
        velocities = sample_velocities(scene, 40, [group], 50, quarter, random)
        lower.append(np.linalg.norm(velocities[:, group[0], :2], axis=-1) < true)
    assert np.mean(lower) == pytest.approx((quarter + 0.5) / 4, abs=0.04)


def test_objects_that_collide_keep_their_relative_velocity(scene: Scene) -> None:
    every = range(len(scene.objects))
    stop, target = 40, 52
    met = [c.objects for c in scene.collisions if stop < c.frame <= target]
    groups = joint_groups(scene, stop, target, every)
    assert sorted(k for group in groups for k in group) == list(every)
    assert met
    for pair in met:
        (group,) = (g for g in groups if pair[0] in g)
        assert pair[1] in group
        velocities = sample_velocities(scene, stop, [group], 6, 1, rng())[..., :3]
        relative = velocities[:, pair[0]] - velocities[:, pair[1]]
        true = scene.velocities[stop, pair[0]] - scene.velocities[stop, pair[1]]
        np.testing.assert_allclose(relative, np.tile(true, (6, 1)), atol=1e-6)
        assert np.abs(velocities - scene.velocities[stop]).max() > 0.05
    assert joint_groups(scene, stop, stop, [0, 2]) == [(0,), (2,)]


def test_only_objects_whose_velocity_can_be_observed_get_another(scene: Scene) -> None:
    every = range(len(scene.objects))
    chosen = moving_objects(scene, 40, every)
    hidden = replace(scene, visible_fraction=scene.visible_fraction.copy())
    hidden.visible_fraction[37, chosen[0]] = 0.0
    assert len(chosen) > 1
    assert moving_objects(hidden, 40, every) == chosen[1:]
