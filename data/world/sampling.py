"""Samples collision scenes in the manner of CLEVRER, and records their oracle.

A scene depends only on the seed, its index, GENERATOR_VERSION, and the benchmark's limits on the
numbers of objects and collisions.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from data.records import COLORS, FPS, MATERIALS, SHAPES, Scene, SceneObject
from data.world.camera import STANDARD_VIEW, Camera
from data.world.physics import STANDARD_PHYSICS, Body, Motion, Physics, shared_simulator
from data.world.shapes import BOUNDING_RADIUS, RADIUS
from data.world.visibility import compute_visibility

if TYPE_CHECKING:
    from conf.schema import BenchmarkConfig

AT_REST = 0.35
"""Probability that an object added for a collision starts at rest."""
SPEED = (1.0, 3.0)
"""Range of initial speeds, simulator units per second."""
COLLISIONS = {2: 0.63, 3: 0.33, 4: 0.04}
"""Probabilities of the intended number of collisions, from a sample of CLEVRER's release."""
CLEAR = 2 * max(BOUNDING_RADIUS.values()) + 0.2
"""Objects that have this distance at every frame never touch, because between two frames their
distance falls by less than 0.1."""
PLACEMENTS = 40
"""Number of attempts to place an object before the scene is sampled again."""


def sample_bodies(seed: int, index: int, limits: BenchmarkConfig) -> tuple[list[Body], Motion]:
    """Sample the bodies of scene `index` and simulate their motion.

    The first body moves. Each further body is placed so that it collides with an earlier body,
    until the scene has its intended number of collisions; the others rest and touch no other body.
    A placement by which a pair touches at the start or collides twice is rejected.
    """
    rng = np.random.default_rng([seed, index])
    while True:
        objects = sample_objects(rng, limits)
        goal = int(rng.choice(list(COLLISIONS), p=list(COLLISIONS.values())))
        bodies = [_entering(objects[0], rng)]
        motion = shared_simulator().simulate(bodies)
        for added in objects[1:]:
            attempts = (
                _try_body(bodies, motion, added, rng, goal, limits.max_collisions)
                for _ in range(PLACEMENTS)
            )
            extended = next(filter(None, attempts), None)
            if extended is None:
                break
            bodies, motion = extended
        if len(bodies) == len(objects) and motion.collisions:
            return bodies, motion


def sample_objects(rng: np.random.Generator, limits: BenchmarkConfig) -> list[SceneObject]:
    """Sample the number of objects in a scene and their distinct appearances."""
    every = [SceneObject(*attributes) for attributes in product(SHAPES, MATERIALS, COLORS)]
    count = int(rng.integers(limits.min_objects, limits.max_objects + 1))
    return [every[k] for k in rng.choice(len(every), count, replace=False)]


def _entering(added: SceneObject, rng: np.random.Generator) -> Body:
    """Sample a body that moves from far away towards the middle of the view."""
    bearing = rng.uniform(0, 2 * np.pi)
    start = np.array([-0.7, 0.0]) + rng.uniform(2.6, 4.0) * unit_vector(bearing)
    goal = np.array([-0.7, 0.0]) + rng.uniform(-1, 1, 2)
    direction = (goal - start) / np.linalg.norm(goal - start)
    speed = rng.uniform(*SPEED)
    return Body(added, start, rng.uniform(0, 2 * np.pi), speed * direction)


def _try_body(
    bodies: list[Body],
    motion: Motion,
    added: SceneObject,
    rng: np.random.Generator,
    goal: int,
    max_collisions: int,
) -> tuple[list[Body], Motion] | None:
    """Add a body that collides with another body or, once there are `goal` collisions, with none.

    Returns:
        All bodies and their motion, or None if the sampled body does not fit.
    """
    is_colliding = len(motion.collisions) < min(goal, max_collisions)
    body = (_colliding if is_colliding else _resting)(added, motion, rng)
    if body is None:
        return None
    extended = [*bodies, body]
    # A body at rest usually stays clear of the others, and then need not be simulated with them.
    combined = None if is_colliding else _combine(motion, body)
    result = combined or shared_simulator().simulate(extended)
    fits = (
        not result.touching_at_start
        and not result.repeated_pair
        and len(result.collisions) <= max_collisions
        and any(len(bodies) in c.objects for c in result.collisions) == is_colliding
    )
    return (extended, result) if fits else None


def _combine(motion: Motion, body: Body) -> Motion | None:
    """Add the motion of a body that touches no other body; return None if it may touch one.

    Bullet solves groups of bodies that do not touch separately, so the result is bit-identical to a
    simulation of all bodies.
    """
    alone = shared_simulator().simulate([body]).states
    distance = np.linalg.norm(motion.positions - alone[..., :3], axis=-1)
    if distance.min() < CLEAR:
        return None
    return replace(motion, states=np.concatenate([motion.states, alone], axis=1))


def _colliding(added: SceneObject, motion: Motion, rng: np.random.Generator) -> Body | None:
    """Sample a body that should collide with another body on screen: at rest in its path, or moving
    towards its future position. Returns None if the sample is unsuitable."""
    other = int(rng.integers(motion.positions.shape[1]))
    frame = int(rng.integers(15, 111))
    place = motion.positions[frame, other, :2] + rng.normal(0, 0.1, 2)
    if not is_on_screen(place):
        return None
    if rng.random() < AT_REST:
        if np.linalg.norm(motion.velocities[frame, other]) < 0.3:
            return None
        return Body(added, place, rng.uniform(0, 2 * np.pi))
    seconds, deceleration = frame / FPS, STANDARD_PHYSICS.friction_deceleration
    speed = rng.uniform(*SPEED)
    if speed - deceleration * seconds < 0.3:
        return None
    travel = speed * seconds - deceleration * seconds**2 / 2
    direction = unit_vector(rng.uniform(0, 2 * np.pi))
    start = place - travel * direction
    return Body(added, start, rng.uniform(0, 2 * np.pi), speed * direction)


def _resting(added: SceneObject, motion: Motion, rng: np.random.Generator) -> Body | None:
    """Sample a body at rest on screen; return None if it is off screen or near another's path."""
    place = np.array([rng.uniform(-3.5, 1.2), rng.uniform(-2.2, 2.2)])
    is_clear = np.linalg.norm(motion.positions[..., :2] - place, axis=-1).min() > 0.7
    if not (is_clear and is_on_screen(place)):
        return None
    return Body(added, place, rng.uniform(0, 2 * np.pi))


def is_on_screen(
    place: np.ndarray, height: float = RADIUS, camera: Camera = STANDARD_VIEW.camera
) -> bool:
    """Return whether a point above a ground position is on screen, with a margin of 20 px."""
    pixel, depth = camera.project(np.array([*place, height]))
    margin = 20
    return bool(
        depth > 1
        and margin < pixel[0] < camera.width - margin
        and margin < pixel[1] < camera.height - margin
    )


def unit_vector(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def format_scene_id(seed: int, index: int) -> str:
    return f"s{seed}-{index:06d}"


def simulate_without(name: str, split: str, bodies: list[Body], removed: int) -> Scene:
    """Simulate a scene again without object `removed`.

    Objects that the removed object never affects, directly or through others, move bit-identically.
    """
    rest = bodies[:removed] + bodies[removed + 1 :]
    return record_scene(name, split, rest, shared_simulator().simulate(rest))


def record_scene(
    name: str,
    split: str,
    bodies: list[Body],
    motion: Motion,
    physics: Physics = STANDARD_PHYSICS,
    camera: Camera = STANDARD_VIEW.camera,
    scenario: str = "",
) -> Scene:
    """Return the scene of a motion, with image positions and visibility for a camera."""
    objects = tuple(body.object for body in bodies)
    states = np.split(motion.states, [3, 7, 10], axis=-1)
    positions, quaternions, velocities, angular_velocities = states
    in_view, fraction = compute_visibility(objects, positions, quaternions, camera)
    floats = {
        "positions": positions,
        "quaternions": quaternions,
        "velocities": velocities,
        "angular_velocities": angular_velocities,
        "image_positions": camera.project(positions)[0],
        "visible_fraction": fraction,
    }
    return Scene(
        scene_id=name,
        split=split,
        objects=objects,
        collisions=motion.collisions,
        in_view=in_view,
        image_size=(camera.width, camera.height),
        fps=physics.fps,
        landings=motion.landings,
        scenario=scenario,
        **{key: array.astype(np.float32) for key, array in floats.items()},
    )
