"""Simulation of rigid bodies with Bullet.

`pybullet` is imported when a client connects, so that reading a built benchmark does not need it.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
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
"""Changes whenever the same seed and index give a different scene."""

SUBSTEPS = 7
"""Physics steps per frame: 175 Hz, as in CLEVRER's raw records."""
SOLVER_ITERATIONS = 20
GRAVITY = 9.81
GROUND_FRICTION, OBJECT_FRICTION = 0.1, 0.3
FRICTION_DECELERATION = GROUND_FRICTION * OBJECT_FRICTION * GRAVITY

CONTACT_FREE_FRAMES = 5
"""A pair's contact is a new event only after more contact-free frames than this."""
MAX_CLOSING_SPEED = 12.5
"""Upper bound on the speed at which two objects approach, simulator units per second."""


@dataclass(frozen=True)
class Physics:
    """Constants of a simulation, and its frame rate."""

    fps: int = FPS
    substeps: int = SUBSTEPS
    gravity: float = GRAVITY
    ground_friction: float = GROUND_FRICTION
    object_friction: float = OBJECT_FRICTION
    ground_restitution: float = 0.0
    """Bullet multiplies it by the object's: with 0 nothing bounces on the ground."""
    rubber_restitution: float = 0.5
    metal_restitution: float = 0.7

    @property
    def reach(self) -> float:
        """Largest distance of centres at which two objects may touch within the next frame."""
        return 2 * max(BOUNDING_RADIUS.values()) + MAX_CLOSING_SPEED / self.fps


STANDARD_PHYSICS = Physics()


@dataclass(frozen=True)
class Body:
    """An object and its initial state: ground position, yaw in radians, ground velocity."""

    look: SceneObject
    position: tuple[float, float]
    yaw: float
    velocity: tuple[float, float]
    height: float | None = None
    """Initial height of the centre of a body in the air; None for a body on the ground."""


@dataclass(frozen=True)
class Motion:
    """The simulated motion of some bodies.

    Attributes:
        states: (F, N, 13) positions, quaternions, linear and angular velocities as in `Scene`.
        collisions: First contacts.
        touching_at_start: Whether any two bodies touch at the first frame.
        repeated_pair: Whether any pair collides more than once.
        landings: Landings of bodies that start in the air.
    """

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
    """Connect a Bullet client without a window and without its console output."""
    with silence(1), silence(2):
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        return BulletClient(pybullet.DIRECT)


@contextmanager
def silence(descriptor: int) -> Iterator[None]:
    """Discard the output of C code to a file descriptor."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(descriptor)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), descriptor)
    try:
        yield
    finally:
        # Otherwise C's buffered output would appear later, in the middle of a progress bar.
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, descriptor)
        os.close(kept)


class World:
    """A Bullet client that runs one simulation after another."""

    def __init__(self) -> None:
        self._bullet = connect()

    def simulate(
        self, bodies: list[Body], frames: int = FRAMES, physics: Physics = STANDARD_PHYSICS
    ) -> Motion:
        """Simulate bodies for `frames` frames; the result is bit-identical every time."""
        ground, handles = self._place(bodies, physics)
        step = self._bullet.stepSimulation
        recorded = np.zeros((frames, len(bodies), 13))
        contacts: dict[tuple[int, int], dict[int, None]] = {}
        in_air = {k for k, body in enumerate(bodies) if body.height is not None}
        landings = []
        recorded[0] = self._state(handles)
        touching_at_start = self._overlapping(handles)
        for frame in range(1, frames):
            near = _near_pairs(recorded[frame - 1, :, :3], physics.reach)
            for _ in range(physics.substeps):
                step()
                for i, j in near:
                    if self._is_contact(handles[i], handles[j]):
                        contacts.setdefault((i, j), {})[frame] = None
                for k in [k for k in in_air if self._is_contact(ground, handles[k])]:
                    in_air.remove(k)
                    landings.append(Landing(frame, k))
            recorded[frame] = self._state(handles)
        collisions, repeated = _debounce(contacts)
        return Motion(recorded, collisions, touching_at_start, repeated, tuple(landings))

    def _is_contact(self, one: int, two: int) -> bool:
        # Bullet keeps the points of pairs that have separated, so only a force counts.
        return any(point[9] > 0 for point in self._bullet.getContactPoints(one, two))

    def _place(self, bodies: list[Body], physics: Physics) -> tuple[int, list[int]]:
        """Reset the world, add the ground and the bodies, and return their handles."""
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setGravity(0, 0, -physics.gravity)
        # With a residual threshold above 0 the number of iterations depends on all objects, so
        # that removing one would change the motion of objects that it never touches.
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
    """The world of this process."""
    return World()


def _near_pairs(positions: np.ndarray, reach: float) -> list[tuple[int, int]]:
    """Pairs that may touch within the next frame."""
    places = positions.tolist()
    return [
        (i, j)
        for (i, one), (j, two) in combinations(enumerate(places), 2)
        if math.dist(one, two) < reach
    ]


def _debounce(
    contacts: Mapping[tuple[int, int], Iterable[int]],
) -> tuple[tuple[Collision, ...], bool]:
    """The first contact of each pair, and whether any pair has a later, separate contact."""
    collisions, repeated = [], False
    for pair, frames in contacts.items():
        first, *later = frames
        collisions.append(Collision(first, pair))
        repeated |= any(
            after - before > CONTACT_FREE_FRAMES + 1 for before, after in pairwise([first, *later])
        )
    return tuple(sorted(collisions, key=lambda c: (c.frame, c.objects))), repeated
