"""Simulated scenes are reproducible, and follow the laws of motion in closed form."""

from __future__ import annotations

import hashlib
import os
import sys

import numpy as np
import pytest

from dynapix.conf.schema import PartConfig, PhysicsConfig, WorldConfig
from dynapix.conf.schema.world import ByMaterial
from dynapix.data.oracle.events import group_contacts
from dynapix.data.records import FPS, Collision, Scene, SceneObject
from dynapix.data.sim.parts import part_box, surface_height
from dynapix.data.sim.physics import Body, Branch, has_repeated, shared_simulator
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sim.shapes import RADIUS
from tests.children import run_child
from tests.data.simulated import CLEVRER, simulate_scene

CUBE = SceneObject("cube", "rubber", "red")
BALL = SceneObject("sphere", "rubber", "red")


def fingerprint(scene: Scene) -> str:
    arrays = b"".join(getattr(scene, name).tobytes() for name in Scene.ARRAYS)
    return hashlib.sha256(arrays + repr((scene.objects, scene.collisions)).encode()).hexdigest()


def test_scenes_are_bit_identical_in_another_process_and_order() -> None:
    # OpenBLAS chooses its kernels by the processor, and they round differently. On a processor with
    # AVX-512, starting velocities in scenes 8 and 38 would differ if they depended on the kernels.
    first = [fingerprint(simulate_scene(0, k)) for k in (38, 1, 8)]
    code = (
        "from tests.data.sim.test_physics import *\n"
        "for k in (8, 38, 1): print(fingerprint(simulate_scene(0, k)))"
    )
    environment = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem"}
    child = run_child([sys.executable, "-c", code], check=True, env=environment)
    assert child.stdout.split()[-3:] == [first[2], first[0], first[1]]


def test_motion_of_objects_added_one_by_one_equals_a_joint_simulation() -> None:
    """The sampled scenes also respect the limits of their world."""
    objects, most = CLEVRER.objects, CLEVRER.start.max_collisions
    for index in range(4):
        sample = sample_scene(CLEVRER, 11, index)
        together = shared_simulator().simulate(sample.bodies, CLEVRER)
        assert np.array_equal(together.states, sample.motion.states)
        assert together.touching == sample.motion.touching
        assert objects.min_count <= len(sample.bodies) <= objects.max_count
        contacts = group_contacts(together.touching, FPS)
        assert 1 <= len(contacts) == len({c.objects for c in contacts}) <= most
        assert all(c.frame > 0 for c in contacts)


def test_friction_decelerates_a_sliding_cube() -> None:
    motion = shared_simulator().simulate(
        [Body(CUBE, (0.0, 0.0), 0.0, (-2.0, 0.0))], CLEVRER, frames=26
    )
    seconds, deceleration = 25 / FPS, CLEVRER.physics.friction_deceleration
    lost = 2.0 - np.linalg.norm(motion.velocities[25, 0])
    travelled = np.linalg.norm(motion.positions[25, 0] - motion.positions[0, 0])
    assert lost == pytest.approx(deceleration * seconds, rel=0.05)
    assert travelled == pytest.approx(2 * seconds - deceleration / 2, rel=0.02)


def test_contacts_within_the_gap_are_one_collision() -> None:
    assert not has_repeated({(0, 1): [10, 11, 16]}, FPS)
    assert has_repeated({(0, 1): [10, 17]}, FPS)
    (one,) = group_contacts({(1, 0): [16, 10, 11]}, FPS)
    assert one == Collision(10, (0, 1), 16)
    two = Collision(10, (0, 1), 10), Collision(17, (0, 1), 17)
    assert group_contacts({(0, 1): [10, 17]}, FPS) == two
    # As many seconds at another frame rate.
    assert len(group_contacts({(0, 1): [10, 13]}, fps=12)) == 1
    assert len(group_contacts({(0, 1): [10, 14]}, fps=12)) == 2


def test_sphere_falls_by_half_g_t_squared_and_lands() -> None:
    world = WorldConfig(physics=PhysicsConfig(frames=40, fps=30, substeps=6, gravity=4.0))
    motion = shared_simulator().simulate([Body(BALL, height=1.5)], world)
    (landing,) = motion.landings
    seconds = np.sqrt(2 * (1.5 - RADIUS) / 4.0)
    assert landing.frame == pytest.approx(np.ceil(seconds * 30), abs=1)
    fall = np.arange(landing.frame) / 30
    expected = 1.5 - 4.0 * fall**2 / 2
    np.testing.assert_allclose(motion.positions[: landing.frame, 0, 2], expected, atol=0.02)


def test_rebound_height_grows_with_the_restitution_of_the_floor() -> None:
    rebounds = []
    for floor in (0.0, 0.5, 0.9):
        physics = PhysicsConfig(
            frames=40, floor_restitution=floor, restitution=ByMaterial(rubber=0.8)
        )
        world = WorldConfig(physics=physics)
        motion = shared_simulator().simulate([Body(BALL, height=1.0)], world)
        (landing,) = motion.landings
        rebounds.append(motion.positions[landing.frame + 1 :, 0, 2].max() - RADIUS)
    none, some, more = rebounds
    assert none == pytest.approx(0, abs=0.01)
    assert none + 0.02 < some < more - 0.02
    assert more < 1.0 - RADIUS


def test_object_slides_down_a_ramp_with_the_acceleration_of_its_slope() -> None:
    ramp = PartConfig([0.0, 0.0, 3.0], [8.0, 2.0, 0.1], tilt=44.0, friction=0.5)
    physics = PhysicsConfig(frames=20, object_friction=0.3)
    world = WorldConfig(physics=physics, parts={"ramp": ramp})
    top = surface_height([part_box(ramp)], np.array([-2.0, 0.0]))
    slope = np.radians(44)
    body = Body(CUBE, (-2.0, 0.0), 0.0, height=top + 0.3 / np.cos(slope))
    velocities = shared_simulator().simulate([body], world).velocities[:, 0]
    gain = 9.81 * (np.sin(slope) - 0.5 * 0.3 * np.cos(slope))
    speeds = np.linalg.norm(velocities, axis=-1)
    assert (speeds[19] - speeds[9]) * 25 / 10 == pytest.approx(gain, rel=0.1)
    down = velocities[19] / speeds[19]
    np.testing.assert_allclose(down, [np.cos(slope), 0, -np.sin(slope)], atol=0.05)


def test_surface_height_follows_a_tilted_part() -> None:
    box = part_box(PartConfig([0.0, 0.0, 1.0], [4.0, 2.0, 0.1], turn=90.0, tilt=30.0))
    slope = np.tan(np.radians(30))
    top = 1.0 + 0.05 / np.cos(np.radians(30))
    for y in (-1.0, 0.0, 1.0):
        # After a turn by 90 degrees, the ramp descends along y.
        assert surface_height([box], np.array([0.3, y])) == pytest.approx(top - slope * y)
    assert surface_height([box], np.array([3.0, 0.0])) == 0


@pytest.mark.parametrize("mass", [1 / 16, 1.0, 16.0])
@pytest.mark.parametrize("restitution", [0.5, 1.4])
def test_head_on_collision_of_a_branch_follows_newtons_law(mass: float, restitution: float) -> None:
    """A moving sphere hits one at rest. Their momentum stays, and they separate at the coefficient
    of restitution times the speed of approach. Bullet also pushes overlapping bodies apart, which
    adds at most a tenth of this speed, whatever the masses and the restitution."""
    world = WorldConfig(physics=PhysicsConfig(floor_friction=0.0, object_friction=0.0))
    states = np.zeros((2, 13))
    states[:, 2], states[:, 6] = RADIUS, 1.0
    speed = 1.5
    states[0, 0], states[0, 7] = -1.0, speed
    branches = [
        Branch(states),
        Branch(states, masses=[mass, 1.0], restitution=restitution),
        Branch(states, passing=(0, 1)),
    ]
    balls = [SceneObject("sphere", "metal", color) for color in ("red", "blue")]
    _, changed, ghost = shared_simulator().simulate_branches(
        balls, [1.0, 1.0], states, branches, world, 26
    )
    # Bullet multiplies the coefficients of the two bodies.
    e = (world.physics.restitution.metal * restitution) ** 2
    one, other = changed.velocities[-1, :, 0]
    assert changed.touching
    assert mass * one + other == pytest.approx(mass * speed)
    assert 0 <= other - one - e * speed < 0.1 * speed
    assert not ghost.touching
    np.testing.assert_allclose(ghost.velocities[-1, :, 0], [speed, 0.0], atol=1e-6)
