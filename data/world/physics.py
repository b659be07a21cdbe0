"""Simulation of rigid bodies with Bullet.

`pybullet` is imported when a client connects, so that reading a built benchmark does not need it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from data.records import FPS, FRAMES, Collision, Landing, SceneObject
from data.world.events import first_contacts
from data.world.shapes import CUBE_HALF, RADIUS

if TYPE_CHECKING:
    from pybullet_utils.bullet_client import BulletClient

GENERATOR_VERSION = "2"
"""Changes whenever the same seed and index give a different scene."""

SOLVER_ITERATIONS = 20
CONTACT_FREE_FRAMES = 5
"""A pair collides again only if more frames than this without contact precede."""


@dataclass(frozen=True)
class Physics:
    """Constants of a simulation, and its frame rate."""

    fps: int = FPS
    substeps: int = 7
    """Simulation steps per frame; 7 x 25 fps = 175 Hz, as in CLEVRER's raw records."""
    gravity: float = 9.81
    ground_friction: float = 0.1
    object_friction: float = 0.3
    ground_restitution: float = 0.0
    """Bullet multiplies it by the object's restitution, so with 0 nothing bounces on the ground."""
    rubber_restitution: float = 0.5
    metal_restitution: float = 0.7

    @property
    def friction_deceleration(self) -> float:
        """Deceleration of a sliding object; Bullet multiplies the two friction coefficients."""
        return self.ground_friction * self.object_friction * self.gravity


STANDARD_PHYSICS = Physics()


@dataclass(frozen=True)
class Body:
    """An object and its initial state: ground position, yaw in radians, ground velocity."""

    object: SceneObject
    position: Sequence[float] | np.ndarray
    yaw: float
    velocity: Sequence[float] | np.ndarray = (0.0, 0.0)
    height: float | None = None
    """Initial height of the centre of a body in the air; None for a body on the ground."""


@dataclass(frozen=True)
class Motion:
    """The simulated motion of some bodies.

    Attributes:
        states: (F, N, 13) positions, quaternions, linear and angular velocities as in `Scene`.
        collisions: First contacts of pairs.
        repeated_pair: Whether any pair collides more than once.
        touching_at_start: Whether any two bodies touch at the first frame.
        landings: Landings of bodies that start in the air.
    """

    states: np.ndarray
    collisions: tuple[Collision, ...]
    repeated_pair: bool
    touching_at_start: bool
    landings: tuple[Landing, ...] = ()

    @property
    def positions(self) -> np.ndarray:
        return self.states[..., 0:3]

    @property
    def velocities(self) -> np.ndarray:
        return self.states[..., 7:10]


def connect() -> BulletClient:
    """Start a Bullet client without a window, and suppress what it prints."""
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
        # Otherwise the buffered output of C would appear later, in the middle of a progress bar.
        ctypes.CDLL(None).fflush(None)
        os.dup2(kept, descriptor)
        os.close(kept)


class Simulator:
    """A Bullet client that runs one simulation after another."""

    def __init__(self) -> None:
        self._bullet = connect()

    def simulate(
        self, bodies: list[Body], frames: int = FRAMES, physics: Physics = STANDARD_PHYSICS
    ) -> Motion:
        """Simulate bodies for `frames` frames. Equal arguments give bit-identical results."""
        ground, handles = self._place(bodies, physics)
        recorded = np.zeros((frames, len(bodies), 13))
        recorded[0] = self._state(handles)
        touching_at_start = any(
            self._bullet.getClosestPoints(a, b, 0.02) for a, b in combinations(handles, 2)
        )
        contacts: dict[tuple[int, int], list[int]] = defaultdict(list)
        in_air = {k for k, body in enumerate(bodies) if body.height is not None}
        landings = []
        for frame in range(1, frames):
            # Bullet also lists points of pairs that have separated; contacts have a normal force.
            for _ in range(physics.substeps):
                self._bullet.stepSimulation()
                for point in self._bullet.getContactPoints():
                    if point[1] != ground and point[2] != ground and point[9] > 0:
                        pair = sorted(map(handles.index, point[1:3]))
                        contacts[tuple(pair)].append(frame)
                for k in list(in_air):
                    points = self._bullet.getContactPoints(ground, handles[k])
                    if any(point[9] > 0 for point in points):
                        in_air.remove(k)
                        landings.append(Landing(frame, k))
            recorded[frame] = self._state(handles)
        return Motion(
            recorded,
            first_contacts((at, pair) for pair, times in contacts.items() for at in times),
            _has_repeated(contacts),
            touching_at_start,
            tuple(landings),
        )

    def _place(self, bodies: list[Body], physics: Physics) -> tuple[int, list[int]]:
        """Reset the world, add the ground and the bodies, and return their handles."""
        bullet = self._bullet
        bullet.resetSimulation()
        bullet.setGravity(0, 0, -physics.gravity)
        # With a residual threshold above 0, the number of iterations depends on all objects, so
        # that removing an object would change the motion of objects that it never touches.
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
        bullet, shape, height = self._bullet, body.object.shape, body.height
        if height is None:
            height = CUBE_HALF if shape == "cube" else RADIUS
        sizes = {
            "sphere": (bullet.GEOM_SPHERE, {"radius": RADIUS}),
            "cube": (bullet.GEOM_BOX, {"halfExtents": [CUBE_HALF] * 3}),
            "cylinder": (bullet.GEOM_CYLINDER, {"radius": RADIUS, "height": 2 * RADIUS}),
        }
        kind, size = sizes[shape]
        form = bullet.createCollisionShape(kind, **size)
        turn = bullet.getQuaternionFromEuler([0, 0, body.yaw])
        handle = bullet.createMultiBody(1.0, form, -1, [*body.position, height], turn)
        bullet.changeDynamics(
            handle,
            -1,
            lateralFriction=physics.object_friction,
            rollingFriction=0,
            spinningFriction=0,
            restitution=getattr(physics, f"{body.object.material}_restitution"),
            linearDamping=0,
            angularDamping=0,
        )
        bullet.resetBaseVelocity(handle, [*body.velocity, 0.0], [0, 0, 0])
        return handle

    def _state(self, handles: list[int]) -> np.ndarray:
        pose, velocity = self._bullet.getBasePositionAndOrientation, self._bullet.getBaseVelocity
        return np.array([list(chain(*pose(k), *velocity(k))) for k in handles])


@cache
def shared_simulator() -> Simulator:
    """Return the simulator of this process."""
    return Simulator()


def _has_repeated(contacts: Mapping[tuple[int, int], Sequence[int]]) -> bool:
    """Return whether any pair has a second, separate contact.

    Args:
        contacts: The frames in which each pair is in contact, in order.
    """
    return any(
        after - before > CONTACT_FREE_FRAMES + 1
        for frames in contacts.values()
        for before, after in pairwise(frames)
    )
