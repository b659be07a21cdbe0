"""Simulated scenes are reproducible and follow the laws of motion; removing an object changes only
the objects that it reaches."""

from __future__ import annotations

import hashlib
import sys

import numpy as np
import pytest

from data.records import FPS, Scene, SceneObject
from data.world.physics import Body, _has_repeated, shared_simulator
from data.world.sampling import record_scene, sample_scene, simulate_without
from tests.children import run_child
from tests.data.simulated import CLEVRER, simulate_scene

CUBE = SceneObject("cube", "rubber", "red")


def fingerprint(scene: Scene) -> str:
    arrays = b"".join(getattr(scene, name).tobytes() for name in Scene.ARRAYS)
    return hashlib.sha256(arrays + repr((scene.objects, scene.collisions)).encode()).hexdigest()


def test_scenes_are_bit_identical_in_another_process_and_order() -> None:
    first = [fingerprint(simulate_scene(3, k)) for k in (2, 0, 1)]
    code = (
        "from tests.data.world.test_physics import *\n"
        "for k in (0, 1, 2): print(fingerprint(simulate_scene(3, k)))"
    )
    second = run_child([sys.executable, "-c", code], check=True).stdout.split()
    assert [first[1], first[2], first[0]] == second[-3:]


def test_friction_decelerates_a_sliding_cube() -> None:
    motion = shared_simulator().simulate(
        [Body(CUBE, (0.0, 0.0), 0.0, (-2.0, 0.0))], CLEVRER, frames=26
    )
    seconds, deceleration = 25 / FPS, CLEVRER.physics.friction_deceleration
    lost = 2.0 - np.linalg.norm(motion.velocities[25, 0])
    travelled = np.linalg.norm(motion.positions[25, 0] - motion.positions[0, 0])
    assert lost == pytest.approx(deceleration * seconds, rel=0.05)
    assert travelled == pytest.approx(2 * seconds - deceleration / 2, rel=0.02)


def test_collision_of_two_spheres_conserves_momentum() -> None:
    spheres = [SceneObject("sphere", "metal", color) for color in ("red", "blue")]
    bodies = [
        Body(spheres[0], (0.0, -1.0), 0, (0.0, 2.0)),
        Body(spheres[1], (0.0, 0.0), 0, (0.0, 0.0)),
    ]
    motion = shared_simulator().simulate(bodies, CLEVRER, frames=40)
    (hit,) = motion.collisions
    # The gap is 1 unit minus two radii of 0.2, and the speed is about 2 units per second.
    assert hit.frame / FPS == pytest.approx(0.6 / 2, abs=0.06)
    before = motion.velocities[hit.frame - 1].sum(axis=0)
    after = motion.velocities[hit.frame].sum(axis=0)
    np.testing.assert_allclose(before[:2], after[:2], atol=0.08)


def test_contacts_within_the_gap_are_one_collision() -> None:
    assert not _has_repeated({(0, 1): [10, 11, 16]})
    assert _has_repeated({(0, 1): [10, 17]})


@pytest.mark.parametrize("index", range(4))
def test_scenes_respect_the_limits(index: int) -> None:
    scene = simulate_scene(1, index)
    assert CLEVRER.objects.min_count <= len(scene.objects) <= CLEVRER.objects.max_count
    assert 1 <= len(scene.collisions) <= CLEVRER.start.max_collisions
    pairs = [c.objects for c in scene.collisions]
    assert len(set(pairs)) == len(pairs)
    assert all(c.frame > 0 for c in scene.collisions)


@pytest.mark.parametrize("index", range(4))
def test_removing_an_object_does_not_affect_untouched_objects(index: int) -> None:
    sample = sample_scene(CLEVRER, 1, index)
    factual = record_scene("factual", "train", sample, CLEVRER)
    for removed in range(len(factual.objects)):
        other = simulate_without("other", "train", sample.bodies, removed, CLEVRER)
        kept = [k for k in range(len(factual.objects)) if k != removed]
        reached = touched_by(factual, removed)
        for k, original in enumerate(kept):
            in_factual = reached.get(original, factual.frames)
            until = min(in_factual, reached_in(other, k, reached, kept))
            same = factual.positions[:until, original] == other.positions[:until, k]
            assert same.all(), (removed, original)


def touched_by(scene: Scene, start: int) -> dict[int, int]:
    """The frame at which `start` first affects each object, directly or through other objects."""
    reached = {start: 0}
    for collision in scene.collisions:
        for one, two in (collision.objects, collision.objects[::-1]):
            if one in reached and two not in reached:
                reached[two] = collision.frame
    return reached


def reached_in(scene: Scene, index: int, reached: dict[int, int], kept: list[int]) -> int:
    """The first frame at which an object of the counterfactual scene collides with an object whose
    path may have changed; the number of frames if there is none."""
    changed = {kept.index(k) for k in reached if k in kept}
    for collision in scene.collisions:
        if changed & set(collision.objects):
            changed |= set(collision.objects)
            if index in collision.objects:
                return collision.frame
    return scene.frames


@pytest.mark.parametrize("index", range(6))
def test_motion_of_objects_added_one_by_one_equals_a_joint_simulation(index: int) -> None:
    sample = sample_scene(CLEVRER, 11, index)
    together = shared_simulator().simulate(sample.bodies, CLEVRER)
    assert np.array_equal(together.states, sample.motion.states)
    assert together.collisions == sample.motion.collisions
