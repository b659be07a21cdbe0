"""Alternative futures of a scene: what would happen if objects moved differently from a frame on.

An alternative future equals the scene up to a frame, at which some objects get other velocities.
Its frames look as plausible as those of the scene, so that only a model that predicts the motion
can tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from data.records import Scene
from data.world.camera import Camera
from data.world.parts import world_boxes
from data.world.physics import shared_simulator
from data.world.visibility import compute_visibility

if TYPE_CHECKING:
    from conf.schema import WorldConfig

MOVING = 0.1
"""Speed (simulator units/s) above which an object counts as moving."""
SPEED = np.log(2.0)
"""Maximum of the random logarithm by which a speed differs from the centre of its futures."""
TURN = np.radians(60)
"""Maximum of the random angle by which a direction differs from the centre of its futures."""


def moving_objects(scene: Scene, frame: int, about: Sequence[int]) -> list[int]:
    """Return the objects of `about` that move along the ground at a frame."""
    speeds = np.linalg.norm(scene.velocities[frame, :, :2], axis=-1)
    return [k for k in about if speeds[k] > MOVING]


def sample_velocities(
    scene: Scene,
    frame: int,
    moving: Sequence[int],
    count: int,
    quarter: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Sample other velocities of moving objects at a frame.

    One or two objects get other speeds and directions, the same objects in all futures. The true
    velocities are one more sample of the distribution of the others: all have a random distance
    from a centre. If the true velocity were the centre itself, the most typical candidate would be
    right.

    Args:
        moving: Indices of objects that move at the frame.
        quarter: The quarter of the range of speeds in which the true speed lies: with 0, most other
            speeds are higher, and with 3, most are lower.

    Returns:
        (count, N, 6) linear and angular velocities.
    """
    original = np.concatenate([scene.velocities[frame], scene.angular_velocities[frame]], axis=-1)
    velocities = np.repeat(original[None].astype(float), count, axis=0)
    for k in rng.choice(moving, min(len(moving), int(rng.integers(1, 3))), replace=False):
        true_speed = SPEED * (rng.uniform(quarter, quarter + 1) / 2 - 1)
        factors = np.exp(rng.uniform(-SPEED, SPEED, count) - true_speed)
        angles = rng.uniform(-TURN, TURN, count) - rng.uniform(-TURN, TURN)
        for changed, factor, angle in zip(velocities, factors, angles, strict=True):
            changed[k] = factor * _turn(changed[k], angle)
    return velocities


def _turn(velocity: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a linear and an angular velocity (6,) about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = velocity.reshape(2, 3).T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1).ravel()


def simulate_futures(
    scene: Scene, frame: int, last: int, velocities: np.ndarray, world: WorldConfig
) -> np.ndarray:
    """Simulate a scene from `frame` to `last` with other velocities (K, N, 6) at `frame`.

    Returns:
        (K, last - frame + 1, N, 13) states.
    """
    return shared_simulator().branch(
        scene.objects,
        scene.object_scales,
        scene_states(scene)[frame].astype(float),
        velocities,
        world,
        last - frame + 1,
    )


def scene_states(scene: Scene) -> np.ndarray:
    """Return positions, quaternions, linear and angular velocities as one array (F, N, 13)."""
    parts = scene.positions, scene.quaternions, scene.velocities, scene.angular_velocities
    return np.concatenate(parts, axis=-1)


def scene_with_states(scene: Scene, name: str, states: np.ndarray, world: WorldConfig) -> Scene:
    """Return a scene with the objects of another one and the states (F, N, 13) of each frame. Its
    collisions and landings are empty."""
    camera = Camera.from_settings(world.camera)
    positions, quaternions, velocities, angular = np.split(states, [3, 7, 10], axis=-1)
    in_view, fraction = compute_visibility(
        scene.objects, positions, quaternions, camera, scene.object_scales, world_boxes(world)
    )
    floats = {
        "positions": positions,
        "quaternions": quaternions,
        "velocities": velocities,
        "angular_velocities": angular,
        "image_positions": camera.project(positions)[0],
        "visible_fraction": fraction,
    }
    return Scene(
        scene_id=name,
        split=scene.split,
        objects=scene.objects,
        collisions=(),
        in_view=in_view,
        image_size=scene.image_size,
        fps=scene.fps,
        scenario=scene.scenario,
        scales=scene.scales,
        speed_bounds=scene.speed_bounds,
        **{key: array.astype(np.float32) for key, array in floats.items()},
    )


def alternative_scene(
    scene: Scene, name: str, frame: int, states: np.ndarray, world: WorldConfig
) -> Scene:
    """Return an alternative future as a scene: the frames of `scene` up to `frame`, then those of
    `states`, whose first frame is `frame`."""
    future = scene_with_states(scene, name, states[1:], world)
    arrays = {
        key: np.concatenate([getattr(scene, key)[: frame + 1], getattr(future, key)])
        for key in Scene.ARRAYS
    }
    return replace(future, **arrays)
