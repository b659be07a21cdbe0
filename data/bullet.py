"""Sample and simulate scenes with Bullet, in the manner of CLEVRER's collision scenes.

A scene is a pure function of (seed, index, GENERATOR_VERSION) and the benchmark's object and
collision limits. `pybullet` is imported where the world is made, so that reading a built benchmark
needs no simulator.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from conf.schema import BenchmarkConfig
from data.geometry import BOUNDING_RADIUS, CUBE_HALF, RADIUS, Camera, visibility
from data.records import COLORS, FPS, FRAMES, MATERIALS, SHAPES, Collision, Scene, SceneObject

if TYPE_CHECKING:
    from pybullet_utils.bullet_client import BulletClient

GENERATOR_VERSION = "2"
"""Changes whenever the same seed and index would give another scene."""

SUBSTEPS = 7
"""Physics steps a frame: 175 Hz, as in CLEVRER's raw records."""
SOLVER_ITERATIONS = 20
GRAVITY = 9.81
GROUND_FRICTION, OBJECT_FRICTION = 0.1, 0.3
RESTITUTION = {"rubber": 0.5, "metal": 0.7}
FRICTION_DECELERATION = GROUND_FRICTION * OBJECT_FRICTION * GRAVITY

AT_REST = 0.35
"""Share of the added objects that start at rest."""
SPEED = (1.0, 3.0)
"""Speeds at the start, simulator units a second."""
CONTACT_FREE_FRAMES = 5
"""A pair's contact is a new event only after more frames than this without one."""
COLLISIONS = {2: 0.63, 3: 0.33, 4: 0.04}
"""How often a scene aims at how many collisions, as a sample of CLEVRER's release has them."""
REACH = 2 * max(BOUNDING_RADIUS.values()) + 0.5
"""Objects whose centres are further apart than this do not touch within the next frame: none moves
faster than 6 units a second."""
CLEAR = 2 * max(BOUNDING_RADIUS.values()) + 0.2
"""Objects whose centres are further apart than this at every frame never touch: between two frames
one comes nearer by less than a tenth."""
PLACEMENTS = 40
"""Tries to place one object before the scene is begun again."""


@dataclass(frozen=True)
class Body:
    """An object and how it starts: ground position, yaw in radians, ground velocity."""

    look: SceneObject
    position: tuple[float, float]
    yaw: float
    velocity: tuple[float, float]


@dataclass(frozen=True)
class Motion:
    """What Bullet did with some bodies: (F, N, 13) their positions, quaternions, linear and angular
    velocities as in `Scene`, and first contacts."""

    states: np.ndarray
    collisions: tuple[Collision, ...]
    touching_at_start: bool
    repeated_pair: bool

    @property
    def positions(self) -> np.ndarray:
        return self.states[..., 0:3]

    @property
    def quaternions(self) -> np.ndarray:
        return self.states[..., 3:7]

    @property
    def velocities(self) -> np.ndarray:
        return self.states[..., 7:10]

    @property
    def angular_velocities(self) -> np.ndarray:
        return self.states[..., 10:13]


def connect() -> BulletClient:
    """A Bullet client without a window, its greetings swallowed."""
    with silence(1), silence(2):
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        return BulletClient(pybullet.DIRECT)


@contextmanager
def silence(descriptor: int) -> Iterator[None]:
    """Send what C writes to a file descriptor nowhere."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(descriptor)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), descriptor)
    try:
        yield
    finally:
        # What C has buffered would else come out later, in the midst of a progress bar.
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, descriptor)
        os.close(kept)


class World:
    """A Bullet world without a window, used for one simulation after another."""

    def __init__(self) -> None:
        self._bullet = connect()

    def simulate(self, bodies: list[Body], frames: int = FRAMES) -> Motion:
        """Run `bodies` for `frames` frames. The same bodies give the same bits every time."""
        handles = self._place(bodies)
        step, contact_points = self._bullet.stepSimulation, self._bullet.getContactPoints
        recorded = np.zeros((frames, len(bodies), 13))
        contacts: dict[tuple[int, int], list[int]] = {}
        recorded[0] = self._state(handles)
        touching_at_start = self._overlapping(handles)
        for frame in range(1, frames):
            near = _near_pairs(recorded[frame - 1, :, :3])
            for _ in range(SUBSTEPS):
                step()
                for i, j in near:
                    points = contact_points(handles[i], handles[j])
                    # Bullet keeps points of pairs that no longer press on each other; only a
                    # force is a contact.
                    if any(point[9] > 0 for point in points):
                        frames_of_pair = contacts.setdefault((i, j), [])
                        if not frames_of_pair or frames_of_pair[-1] != frame:
                            frames_of_pair.append(frame)
            recorded[frame] = self._state(handles)
        collisions, repeated = _debounce(contacts)
        return Motion(recorded, collisions, touching_at_start, repeated)

    def _place(self, bodies: list[Body]) -> list[int]:
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setGravity(0, 0, -GRAVITY)
        # A residual threshold of 0 keeps the number of iterations from depending on objects that
        # an object never meets: without it, removing one object moves all the others.
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / (FPS * SUBSTEPS),
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=0,
            deterministicOverlappingPairs=1,
        )
        ground = bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE))
        bullet.changeDynamics(ground, -1, lateralFriction=GROUND_FRICTION, restitution=0)
        return [self._add(body) for body in bodies]

    def _add(self, body: Body) -> int:
        bullet = self._bullet
        shape, height = body.look.shape, CUBE_HALF if body.look.shape == "cube" else RADIUS
        if shape == "sphere":
            form = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=RADIUS)
        elif shape == "cube":
            form = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[CUBE_HALF] * 3)
        else:
            form = bullet.createCollisionShape(
                bullet.GEOM_CYLINDER, radius=RADIUS, height=2 * RADIUS
            )
        turn = bullet.getQuaternionFromEuler([0, 0, body.yaw])
        handle = bullet.createMultiBody(1.0, form, -1, [*body.position, height], turn)
        bullet.changeDynamics(
            handle,
            -1,
            lateralFriction=OBJECT_FRICTION,
            rollingFriction=0,
            spinningFriction=0,
            restitution=RESTITUTION[body.look.material],
            linearDamping=0,
            angularDamping=0,
        )
        bullet.resetBaseVelocity(handle, [*body.velocity, 0.0], [0, 0, 0])
        return handle

    def _state(self, handles: list[int]) -> np.ndarray:
        pose, velocity = self._bullet.getBasePositionAndOrientation, self._bullet.getBaseVelocity
        rows = []
        for handle in handles:
            position, turn = pose(handle)
            linear, angular = velocity(handle)
            rows.append([*position, *turn, *linear, *angular])
        return np.array(rows)

    def _overlapping(self, handles: list[int]) -> bool:
        return any(
            self._bullet.getClosestPoints(a, b, 0.02)
            for k, a in enumerate(handles)
            for b in handles[k + 1 :]
        )


@cache
def world() -> World:
    """This process's world."""
    return World()


def _near_pairs(positions: np.ndarray) -> list[tuple[int, int]]:
    """Pairs that could touch within the next frame, and are polled."""
    places = positions.tolist()
    return [
        (i, j)
        for (i, one), (j, two) in combinations(enumerate(places), 2)
        if math.dist(one, two) < REACH
    ]


def _debounce(contacts: dict[tuple[int, int], list[int]]) -> tuple[tuple[Collision, ...], bool]:
    events, repeated = [], False
    for pair, frames in contacts.items():
        events.append(Collision(frames[0], pair))
        repeated |= any(
            later - earlier > CONTACT_FREE_FRAMES + 1 for earlier, later in pairwise(frames)
        )
    return tuple(sorted(events, key=lambda c: (c.frame, c.objects))), repeated


def sample_bodies(seed: int, index: int, limits: BenchmarkConfig) -> tuple[list[Body], Motion]:
    """The bodies of scene `index` and what they do: one that moves, then one after the other placed
    or aimed so that it meets an earlier one, until the scene has its collisions; the rest stand by.

    Scenes whose pairs touch at the start or meet again are thrown away and begun anew.
    """
    rng = np.random.default_rng([seed, index])
    every_look = [SceneObject(*look) for look in product(SHAPES, MATERIALS, COLORS)]
    while True:
        count = int(rng.integers(limits.min_objects, limits.max_objects + 1))
        looks = [every_look[k] for k in rng.choice(len(every_look), count, replace=False)]
        goal = int(rng.choice(list(COLLISIONS), p=list(COLLISIONS.values())))
        most = limits.max_collisions
        bodies = [_entering(looks[0], rng)]
        motion = world().simulate(bodies)
        for look in looks[1:]:
            grown = _add_body(bodies, motion, look, rng, min(goal, most), most)
            if grown is None:
                break
            bodies, motion = grown
        if len(bodies) == count and motion.collisions:
            return bodies, motion


def _entering(look: SceneObject, rng: np.random.Generator) -> Body:
    """A body that comes in from outside the view, towards its middle."""
    bearing = rng.uniform(0, 2 * np.pi)
    start = np.array([-0.7, 0.0]) + rng.uniform(2.6, 4.0) * _unit(bearing)
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
        result = (None if wanted else _beside(motion, body)) or world().simulate(trial)
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
    alone = world().simulate([body]).states
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
    if not _on_screen(place):
        return None
    if rng.random() < AT_REST:
        if np.linalg.norm(motion.velocities[frame, other]) < 0.3:
            return None
        return Body(look, _pair(place), rng.uniform(0, 2 * np.pi), (0.0, 0.0))
    seconds = frame / FPS
    speed = rng.uniform(*SPEED)
    if speed - FRICTION_DECELERATION * seconds < 0.3:
        return None
    travel = speed * seconds - FRICTION_DECELERATION * seconds**2 / 2
    direction = _unit(rng.uniform(0, 2 * np.pi))
    return _moving(look, place - travel * direction, direction, speed, rng)


def _standing_by(look: SceneObject, motion: Motion, rng: np.random.Generator) -> Body | None:
    """A body at rest on screen, clear of every path."""
    place = np.array([rng.uniform(-3.5, 1.2), rng.uniform(-2.2, 2.2)])
    clear = np.linalg.norm(motion.positions[..., :2] - place, axis=-1).min() > 0.7
    if not (clear and _on_screen(place)):
        return None
    return Body(look, _pair(place), rng.uniform(0, 2 * np.pi), (0.0, 0.0))


def _moving(
    look: SceneObject,
    start: np.ndarray,
    direction: np.ndarray,
    speed: float,
    rng: np.random.Generator,
) -> Body:
    return Body(look, _pair(start), rng.uniform(0, 2 * np.pi), _pair(speed * direction))


def _on_screen(place: np.ndarray) -> bool:
    camera = Camera()
    pixel, depth = camera.project(np.array([*place, RADIUS]))
    margin = 20
    return bool(
        depth > 1
        and margin < pixel[0] < camera.width - margin
        and margin < pixel[1] < camera.height - margin
    )


def _unit(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def scene_id(seed: int, index: int) -> str:
    return f"s{seed}-{index:06d}"


def simulate_scene(seed: int, index: int, split: str, limits: BenchmarkConfig) -> Scene:
    """Scene `index` of `seed` with its whole oracle."""
    return record(scene_id(seed, index), split, *sample_bodies(seed, index, limits))


def without(name: str, split: str, bodies: list[Body], removed: int) -> Scene:
    """The counterfactual of a scene of `bodies`: run again with object `removed` absent. What that
    object never touched, directly or through others, moves bit for bit as before."""
    rest = bodies[:removed] + bodies[removed + 1 :]
    return record(name, split, rest, world().simulate(rest))


def record(name: str, split: str, bodies: list[Body], motion: Motion) -> Scene:
    """What bodies did, observed by the camera: a scene."""
    objects = tuple(body.look for body in bodies)
    camera = Camera()
    in_view, fraction = visibility(objects, motion.positions, motion.quaternions, camera)
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
    )
    return replace(scene, **{k: getattr(scene, k).astype(np.float32) for k in _FLOATS})


_FLOATS = tuple(name for name in Scene.ARRAYS if name != "in_view")
