"""Simulate bodies with Bullet: where they start, by what physics, and what becomes of them.

`pybullet` is imported where the world is made, so that reading a built benchmark needs no
simulator.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from data.records import FPS, FRAMES, Collision, Landing, SceneObject
from data.world.shapes import BOUNDING_RADIUS, CUBE_HALF, RADIUS

if TYPE_CHECKING:
    from pybullet_utils.bullet_client import BulletClient

GENERATOR_VERSION = "2"
"""Changes whenever the same seed and index would give another scene."""

SUBSTEPS = 7
"""Physics steps a frame: 175 Hz, as in CLEVRER's raw records."""
SOLVER_ITERATIONS = 20
GRAVITY = 9.81
GROUND_FRICTION, OBJECT_FRICTION = 0.1, 0.3
FRICTION_DECELERATION = GROUND_FRICTION * OBJECT_FRICTION * GRAVITY

CONTACT_FREE_FRAMES = 5
"""A pair's contact is a new event only after more frames than this without one."""
CLOSING = 12.5
"""No two objects come nearer faster than this, simulator units a second."""


@dataclass(frozen=True)
class Physics:
    """What makes bodies move as they do, and how often that is recorded."""

    fps: int = FPS
    substeps: int = SUBSTEPS
    """Physics steps a frame."""
    gravity: float = GRAVITY
    ground_friction: float = GROUND_FRICTION
    object_friction: float = OBJECT_FRICTION
    ground_restitution: float = 0.0
    """Bullet multiplies it by an object's: on a ground of 0 nothing bounces."""
    rubber_restitution: float = 0.5
    metal_restitution: float = 0.7

    @property
    def reach(self) -> float:
        """Objects whose centres are further apart than this do not touch within the next frame."""
        return 2 * max(BOUNDING_RADIUS.values()) + CLOSING / self.fps


STANDARD_PHYSICS = Physics()


@dataclass(frozen=True)
class Body:
    """An object and how it starts: ground position, yaw in radians, ground velocity."""

    look: SceneObject
    position: tuple[float, float]
    yaw: float
    velocity: tuple[float, float]
    height: float | None = None
    """Of its centre, where it starts in the air; None stands on the ground."""


@dataclass(frozen=True)
class Motion:
    """What Bullet did with some bodies: (F, N, 13) their positions, quaternions, linear and angular
    velocities as in `Scene`, first contacts, and landings of bodies that started in the air."""

    states: np.ndarray
    collisions: tuple[Collision, ...]
    touching_at_start: bool
    repeated_pair: bool
    landings: tuple[Landing, ...] = ()

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

    def simulate(
        self, bodies: list[Body], frames: int = FRAMES, physics: Physics = STANDARD_PHYSICS
    ) -> Motion:
        """Run `bodies` for `frames` frames. The same bodies give the same bits every time."""
        ground, handles = self._place(bodies, physics)
        step = self._bullet.stepSimulation
        recorded = np.zeros((frames, len(bodies), 13))
        contacts: dict[tuple[int, int], list[int]] = {}
        in_air = {k for k, body in enumerate(bodies) if body.height is not None}
        landings = []
        recorded[0] = self._state(handles)
        touching_at_start = self._overlapping(handles)
        for frame in range(1, frames):
            near = _near_pairs(recorded[frame - 1, :, :3], physics.reach)
            for _ in range(physics.substeps):
                step()
                for i, j in near:
                    if self._press(handles[i], handles[j]):
                        frames_of_pair = contacts.setdefault((i, j), [])
                        if not frames_of_pair or frames_of_pair[-1] != frame:
                            frames_of_pair.append(frame)
                for k in [k for k in in_air if self._press(ground, handles[k])]:
                    in_air.remove(k)
                    landings.append(Landing(frame, k))
            recorded[frame] = self._state(handles)
        collisions, repeated = _debounce(contacts)
        return Motion(recorded, collisions, touching_at_start, repeated, tuple(landings))

    def _press(self, one: int, two: int) -> bool:
        # Bullet keeps points of pairs that no longer press on each other; only a force is a
        # contact.
        return any(point[9] > 0 for point in self._bullet.getContactPoints(one, two))

    def _place(self, bodies: list[Body], physics: Physics) -> tuple[int, list[int]]:
        """The handles of the ground and of the bodies."""
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setGravity(0, 0, -physics.gravity)
        # A residual threshold of 0 keeps the number of iterations from depending on objects that
        # an object never meets: without it, removing one object moves all the others.
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / (physics.fps * physics.substeps),
            numSolverIterations=SOLVER_ITERATIONS,
            solverResidualThreshold=0,
            deterministicOverlappingPairs=1,
        )
        ground = bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE))
        bullet.changeDynamics(
            ground,
            -1,
            lateralFriction=physics.ground_friction,
            restitution=physics.ground_restitution,
        )
        return ground, [self._add(body, physics) for body in bodies]

    def _add(self, body: Body, physics: Physics) -> int:
        bullet, shape, height = self._bullet, body.look.shape, body.height
        if height is None:
            height = CUBE_HALF if shape == "cube" else RADIUS
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
            lateralFriction=physics.object_friction,
            rollingFriction=0,
            spinningFriction=0,
            restitution=(
                physics.metal_restitution
                if body.look.material == "metal"
                else physics.rubber_restitution
            ),
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
def shared_world() -> World:
    """This process's world."""
    return World()


def _near_pairs(positions: np.ndarray, reach: float) -> list[tuple[int, int]]:
    """Pairs that could touch within the next frame, and are polled."""
    places = positions.tolist()
    return [
        (i, j)
        for (i, one), (j, two) in combinations(enumerate(places), 2)
        if math.dist(one, two) < reach
    ]


def _debounce(contacts: dict[tuple[int, int], list[int]]) -> tuple[tuple[Collision, ...], bool]:
    events, repeated = [], False
    for pair, frames in contacts.items():
        events.append(Collision(frames[0], pair))
        repeated |= any(
            later - earlier > CONTACT_FREE_FRAMES + 1 for earlier, later in pairwise(frames)
        )
    return tuple(sorted(events, key=lambda c: (c.frame, c.objects))), repeated
