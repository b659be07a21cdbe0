"""Sample scenes in the manner of CLEVRER's collision scenes, and put down their oracle.

A scene is a pure function of (seed, index, GENERATOR_VERSION) and the benchmark's object and
collision limits.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from conf.schema import BenchmarkConfig
from data.records import COLORS, FPS, MATERIALS, SHAPES, Scene, SceneObject
from data.world.camera import STANDARD_CAMERA, Camera
from data.world.physics import (
    FRICTION_DECELERATION,
    STANDARD_PHYSICS,
    Body,
    Motion,
    Physics,
    shared_world,
)
from data.world.shapes import BOUNDING_RADIUS, RADIUS
from data.world.visibility import compute_visibility

AT_REST = 0.35
"""Share of the added objects that start at rest."""
SPEED = (1.0, 3.0)
"""Speeds at the start, simulator units a second."""
COLLISIONS = {2: 0.63, 3: 0.33, 4: 0.04}
"""How often a scene aims at how many collisions, as a sample of CLEVRER's release has them."""
CLEAR = 2 * max(BOUNDING_RADIUS.values()) + 0.2
"""Objects whose centres are further apart than this at every frame never touch: between two frames
one comes nearer by less than a tenth."""
PLACEMENTS = 40
"""Tries to place one object before the scene is begun again."""


def sample_bodies(seed: int, index: int, limits: BenchmarkConfig) -> tuple[list[Body], Motion]:
    """The bodies of scene `index` and what they do: one that moves, then one after the other placed
    or aimed so that it meets an earlier one, until the scene has its collisions; the rest stand by.

    Scenes whose pairs touch at the start or meet again are thrown away and begun anew.
    """
    rng = np.random.default_rng([seed, index])
    while True:
        looks = sample_looks(rng, limits)
        count = len(looks)
        goal = int(rng.choice(list(COLLISIONS), p=list(COLLISIONS.values())))
        most = limits.max_collisions
        bodies = [_entering(looks[0], rng)]
        motion = shared_world().simulate(bodies)
        for look in looks[1:]:
            grown = _add_body(bodies, motion, look, rng, min(goal, most), most)
            if grown is None:
                break
            bodies, motion = grown
        if len(bodies) == count and motion.collisions:
            return bodies, motion


def sample_looks(rng: np.random.Generator, limits: BenchmarkConfig) -> list[SceneObject]:
    """As many looks as a scene has objects, no two alike."""
    every_look = [SceneObject(*look) for look in product(SHAPES, MATERIALS, COLORS)]
    count = int(rng.integers(limits.min_objects, limits.max_objects + 1))
    return [every_look[k] for k in rng.choice(len(every_look), count, replace=False)]


def _entering(look: SceneObject, rng: np.random.Generator) -> Body:
    """A body that comes in from outside the view, towards its middle."""
    bearing = rng.uniform(0, 2 * np.pi)
    start = np.array([-0.7, 0.0]) + rng.uniform(2.6, 4.0) * unit_vector(bearing)
    goal = np.array([-0.7, 0.0]) + rng.uniform(-1, 1, 2)
    direction = (goal - start) / np.linalg.norm(goal - start)
    return _moving(look, start, direction, rng.uniform(*SPEED), rng)


def _add_body(
    bodies: list[Body],
    motion: Motion,
    look: SceneObject,
    rng: np.random.Generator,
    goal: int,
    most: int,
) -> tuple[list[Body], Motion] | None:
    """`bodies` with one more, and their motion: one that meets another while there are fewer than
    `goal` collisions, then one that meets none. None where no place was found."""
    wanted = len(motion.collisions) < goal
    for _ in range(PLACEMENTS):
        body = _meeting(look, motion, rng) if wanted else _standing_by(look, motion, rng)
        if body is None:
            continue
        trial = [*bodies, body]
        # A body that is to meet another needs them all; it seldom stays out of reach.
        result = (None if wanted else _beside(motion, body)) or shared_world().simulate(trial)
        met = any(len(bodies) in c.objects for c in result.collisions)
        if (
            not result.touching_at_start
            and not result.repeated_pair
            and len(result.collisions) <= most
            and met == wanted
        ):
            return trial, result
    return None


def _beside(motion: Motion, body: Body) -> Motion | None:
    """What `body` and the bodies of `motion` do together, where it stays out of reach of them all:
    what each does alone, to the bit, for Bullet solves what does not touch apart. None where it may
    touch one."""
    alone = shared_world().simulate([body]).states
    apart = np.linalg.norm(motion.positions - alone[..., :3], axis=-1)
    if apart.min() < CLEAR:
        return None
    return replace(motion, states=np.concatenate([motion.states, alone], axis=1))


def _meeting(look: SceneObject, motion: Motion, rng: np.random.Generator) -> Body | None:
    """A body that should meet one of the others at a moment in view: at rest in its way, or aimed
    at where it will be."""
    other = int(rng.integers(motion.positions.shape[1]))
    frame = int(rng.integers(15, 111))
    place = motion.positions[frame, other, :2] + rng.normal(0, 0.1, 2)
    if not is_on_screen(place):
        return None
    if rng.random() < AT_REST:
        if np.linalg.norm(motion.velocities[frame, other]) < 0.3:
            return None
        return Body(look, as_pair(place), rng.uniform(0, 2 * np.pi), (0.0, 0.0))
    seconds = frame / FPS
    speed = rng.uniform(*SPEED)
    if speed - FRICTION_DECELERATION * seconds < 0.3:
        return None
    travel = speed * seconds - FRICTION_DECELERATION * seconds**2 / 2
    direction = unit_vector(rng.uniform(0, 2 * np.pi))
    return _moving(look, place - travel * direction, direction, speed, rng)


def _standing_by(look: SceneObject, motion: Motion, rng: np.random.Generator) -> Body | None:
    """A body at rest on screen, clear of every path."""
    place = np.array([rng.uniform(-3.5, 1.2), rng.uniform(-2.2, 2.2)])
    clear = np.linalg.norm(motion.positions[..., :2] - place, axis=-1).min() > 0.7
    if not (clear and is_on_screen(place)):
        return None
    return Body(look, as_pair(place), rng.uniform(0, 2 * np.pi), (0.0, 0.0))


def _moving(
    look: SceneObject,
    start: np.ndarray,
    direction: np.ndarray,
    speed: float,
    rng: np.random.Generator,
) -> Body:
    return Body(look, as_pair(start), rng.uniform(0, 2 * np.pi), as_pair(speed * direction))


def is_on_screen(
    place: np.ndarray, height: float = RADIUS, camera: Camera = STANDARD_CAMERA
) -> bool:
    """Whether an object's centre at a ground position and height shows, with some margin."""
    pixel, depth = camera.project(np.array([*place, height]))
    margin = 20
    return bool(
        depth > 1
        and margin < pixel[0] < camera.width - margin
        and margin < pixel[1] < camera.height - margin
    )


def unit_vector(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def as_pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def format_scene_id(seed: int, index: int) -> str:
    return f"s{seed}-{index:06d}"


def simulate_scene(seed: int, index: int, split: str, limits: BenchmarkConfig) -> Scene:
    """Scene `index` of `seed` with its whole oracle."""
    return record_scene(format_scene_id(seed, index), split, *sample_bodies(seed, index, limits))


def simulate_without(name: str, split: str, bodies: list[Body], removed: int) -> Scene:
    """The counterfactual of a scene of `bodies`: run again with object `removed` absent. What that
    object never touched, directly or through others, moves bit for bit as before."""
    rest = bodies[:removed] + bodies[removed + 1 :]
    return record_scene(name, split, rest, shared_world().simulate(rest))


def record_scene(
    name: str,
    split: str,
    bodies: list[Body],
    motion: Motion,
    physics: Physics = STANDARD_PHYSICS,
    camera: Camera = STANDARD_CAMERA,
    scenario: str = "",
) -> Scene:
    """What bodies did, observed by a camera: a scene."""
    objects = tuple(body.look for body in bodies)
    in_view, fraction = compute_visibility(objects, motion.positions, motion.quaternions, camera)
    image_positions, _ = camera.project(motion.positions)
    scene = Scene(
        scene_id=name,
        split=split,
        objects=objects,
        collisions=motion.collisions,
        positions=motion.positions,
        quaternions=motion.quaternions,
        velocities=motion.velocities,
        angular_velocities=motion.angular_velocities,
        image_positions=image_positions,
        in_view=in_view,
        visible_fraction=fraction,
        image_size=(camera.width, camera.height),
        fps=physics.fps,
        landings=motion.landings,
        scenario=scenario,
    )
    return replace(scene, **{k: getattr(scene, k).astype(np.float32) for k in _FLOATS})


_FLOATS = tuple(name for name in Scene.ARRAYS if name != "in_view")
