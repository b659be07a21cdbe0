"""Alternative futures of a scene: what would happen if objects moved differently from a frame on.

An alternative future equals the scene up to a frame, at which some objects get other velocities.
Its frames look as plausible as those of the scene, so that only a model that predicts the motion
can tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.oracle.displacement import visible_positions
from dynapix.data.oracle.events import collisions_in
from dynapix.data.records import Scene
from dynapix.data.sim.physics import Branch, Motion, shared_simulator
from dynapix.data.sources.scenes import oracle_arrays

MOVING = 0.1
"""Speed (simulator units/s) above which an object counts as moving."""
SEEN_FRAMES = 5
"""Number of last frames of a prefix in which an object must be visible to get another velocity: in
fewer frames, its true velocity could not be observed."""
MAX_LOG_FACTOR = np.log(2.0)
"""Speeds differ from a central speed by a factor of at most 2; this is its logarithm."""
MAX_TURN = np.radians(60)
"""Maximum angle between a direction and the central direction, to either side."""

Group = tuple[int, ...]
"""Indices of objects whose velocities change together."""


def moving_objects(scene: Scene, frame: int, subjects: Sequence[int]) -> list[int]:
    """Return the objects of `subjects` that move along the ground at a frame and are visible in the
    last `SEEN_FRAMES` frames up to it."""
    speeds = np.linalg.norm(scene.velocities[frame, :, :2], axis=-1)
    seen = visible_positions(scene)[1][max(frame - SEEN_FRAMES + 1, 0) : frame + 1].all(axis=0)
    return [k for k in subjects if speeds[k] > MOVING and seen[k]]


def joint_groups(scene: Scene, frame: int, last: int, moving: Sequence[int]) -> list[Group]:
    """Divide moving objects into groups that keep the collisions of the scene: objects that collide
    after `frame` and up to `last`, directly or through others, form a group. If all get the same
    additional velocity, they still collide at the same moments."""
    groups = [{k} for k in range(len(scene.objects))]
    for collision in collisions_in(scene, frame + 1, last):
        one, two = (next(g for g in groups if k in g) for k in collision.objects)
        if one is not two:
            groups.remove(two)
            one |= two
    return [tuple(sorted(group)) for group in groups if group & {*moving}]


def sample_velocities(
    scene: Scene,
    frame: int,
    groups: Sequence[Group],
    count: int,
    quarter: int,
    rng: np.random.Generator,
) -> np.ndarray:
    """Sample other velocities of one or two groups of objects at a frame.

    The same groups change in all futures. The mean velocity of a group gets another speed and
    direction; the velocities of its objects relative to each other stay. The true velocity is one
    more sample of the distribution of the others: all have a random distance from a centre. If the
    true velocity were the centre itself, the most typical candidate would be right.

    Args:
        groups: Groups of objects, from which one or two are chosen.
        quarter: The quarter of the range of speeds in which the true speed lies: with 0, most other
            speeds are higher, and with 3, most are lower.

    Returns:
        (count, N, 6) linear and angular velocities.
    """
    original = np.concatenate([scene.velocities[frame], scene.angular_velocities[frame]], axis=-1)
    velocities = np.repeat(original[None].astype(float), count, axis=0)
    chosen = rng.choice(len(groups), min(len(groups), int(rng.integers(1, 3))), replace=False)
    for group in (list(groups[k]) for k in chosen):
        true_speed = MAX_LOG_FACTOR * (rng.uniform(quarter, quarter + 1) / 2 - 1)
        factors = np.exp(rng.uniform(-MAX_LOG_FACTOR, MAX_LOG_FACTOR, count) - true_speed)
        angles = rng.uniform(-MAX_TURN, MAX_TURN, count) - rng.uniform(-MAX_TURN, MAX_TURN)
        for changed, factor, angle in zip(velocities, factors, angles, strict=True):
            if len(group) == 1:
                changed[group] = factor * turn_velocity(changed[group[0]], angle)
            else:
                mean = changed[group].mean(axis=0)
                changed[group, :3] += (factor * turn_velocity(mean, angle) - mean)[:3]
    return velocities


def turn_velocity(velocity: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a linear and an angular velocity (6,) about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = velocity.reshape(2, 3).T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1).ravel()


def simulate_futures(
    scene: Scene, frame: int, last: int, branches: Sequence[Branch], world: WorldConfig
) -> list[Motion]:
    """Simulate other continuations of a scene from `frame` to `last`."""
    states, count = scene_states(scene)[frame].astype(float), last - frame + 1
    return shared_simulator().simulate_branches(
        scene.objects, scene.object_scales, states, branches, world, count
    )


def branches_of_velocities(scene: Scene, frame: int, velocities: np.ndarray) -> list[Branch]:
    """Return continuations of a scene with other velocities (K, N, 6) at a frame."""
    poses = scene_states(scene)[frame, :, :7].astype(float)
    return [Branch(np.concatenate([poses, own], axis=-1)) for own in velocities]


def scene_states(scene: Scene) -> np.ndarray:
    """Return positions, quaternions, linear and angular velocities as one array (F, N, 13)."""
    parts = scene.positions, scene.quaternions, scene.velocities, scene.angular_velocities
    return np.concatenate(parts, axis=-1)


def own_motion(scene: Scene, frame: int, last: int) -> Motion:
    """Return the scene's own motion from `frame` to `last`, without its contacts."""
    return Motion(scene_states(scene)[frame : last + 1].astype(float), {})


def scene_with_states(scene: Scene, name: str, states: np.ndarray, world: WorldConfig) -> Scene:
    """Return a scene with the objects of another one and the states (F, N, 13) of each frame. Its
    collisions and landings are empty."""
    arrays = oracle_arrays(scene.objects, scene.object_scales, states, world)
    return replace(scene, scene_id=name, collisions=(), landings=(), **arrays)


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
