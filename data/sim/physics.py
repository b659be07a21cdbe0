"""Simulation of rigid bodies with Bullet.

`pybullet` is imported when a client connects, so that reading a built benchmark does not need it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations, pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.records import Landing, SceneObject
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.shapes import CUBE_HALF, RADIUS, half_height

if TYPE_CHECKING:
    from pybullet_utils.bullet_client import BulletClient


SOLVER_ITERATIONS = 20
LONGEST_BREAK = 0.2
"""Seconds without touch that do not end a contact of a pair."""
TOUCHING = 0.02
"""Distance (simulator units) below which bodies touch at the start."""

Touching = Mapping[tuple[int, int], Sequence[int]]
"""The frames in which each pair of objects (lower index first) touches, in order."""


@dataclass(frozen=True)
class Body:
    """An object and its initial state: ground position, yaw in radians, ground velocity."""

    object: SceneObject
    position: Sequence[float] | np.ndarray = (0.0, 0.0)
    yaw: float = 0.0
    velocity: Sequence[float] | np.ndarray = (0.0, 0.0)
    height: float | None = None
    """Initial height of the centre of a body in the air; None for a body on the floor."""
    scale: float = 1.0
    """Size, as a multiple of the standard size of the shape."""


@dataclass(frozen=True)
class Branch:
    """A continuation of a simulation: the states from which it starts, and what else changes.

    Attributes:
        states: (N, 13) positions, quaternions, linear and angular velocities at the start.
        masses: (N,) factors of the objects' masses; empty for 1.
        restitution: Factor of the restitution of all objects.
        passing: Two objects that pass through each other, if any.
    """

    states: np.ndarray
    masses: Sequence[float] = ()
    restitution: float = 1.0
    passing: tuple[int, int] | None = None


@dataclass(frozen=True)
class Motion:
    """The simulated motion of some bodies.

    Attributes:
        states: (F, N, 13) positions, quaternions, linear and angular velocities as in `Scene`.
        touching: The frames in which each pair touches.
        landings: Landings, on the floor or on a part, of bodies that start in the air.
        is_rejected: Whether the simulation stopped because the caller rejected its contacts.
        touching_at_start: Whether any two bodies, or a body and a part, touch at the first frame.
            Such a motion is not simulated: it has the first frame only.
    """

    states: np.ndarray
    touching: Touching
    landings: tuple[Landing, ...] = ()
    is_rejected: bool = False
    touching_at_start: bool = False

    @property
    def positions(self) -> np.ndarray:
        return self.states[..., 0:3]

    @property
    def velocities(self) -> np.ndarray:
        return self.states[..., 7:10]


def start_bullet() -> BulletClient:
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
        self._bullet = start_bullet()

    def simulate(
        self,
        bodies: Sequence[Body],
        world: WorldConfig,
        frames: int | None = None,
        is_rejected: Callable[[Touching], bool] = lambda touching: False,
    ) -> Motion:
        """Simulate bodies in a world, by default for its number of frames. Equal arguments give
        bit-identical results. `is_rejected` says whether the contacts so far make the motion
        useless: the simulation then stops, and the result is the motion up to this frame."""
        fixed = self._reset(world)
        handles = [self._add_body(body, world) for body in bodies]
        if any(
            self._bullet.getClosestPoints(a, b, TOUCHING)
            for a, b in chain(combinations(handles, 2), product(handles, fixed[1:]))
        ):
            return Motion(self._state(handles)[None], {}, touching_at_start=True)
        in_air = {k for k, body in enumerate(bodies) if body.height is not None}
        frames = frames or world.physics.frames
        return self._run(handles, fixed, world, frames, in_air, is_rejected)

    def simulate_branches(
        self,
        objects: Sequence[SceneObject],
        scales: Sequence[float],
        states: np.ndarray,
        branches: Sequence[Branch],
        world: WorldConfig,
        frames: int,
    ) -> list[Motion]:
        """Simulate several continuations of a scene, whose objects have the states (N, 13).

        Equal arguments give bit-identical results. A branch with the states of the scene is close
        to an uninterrupted simulation, but not equal, because Bullet keeps contacts from step to
        step. So a branch is also close, but not equal, to the same branch after others.
        """
        fixed = self._reset(world)
        handles = [
            self._add(*each, world) for each in zip(objects, scales, states.tolist(), strict=True)
        ]
        start = self._bullet.saveState()
        motions = []
        for branch in branches:
            self._bullet.restoreState(start)
            for handle, old, new in zip(handles, states, branch.states, strict=True):
                if not np.array_equal(old[:7], new[:7]):
                    self._bullet.resetBasePositionAndOrientation(handle, new[:3], new[3:7])
                self._bullet.resetBaseVelocity(handle, new[7:10].tolist(), new[10:13].tolist())
            with self._changed(handles, branch):
                motions.append(self._run(handles, fixed, world, frames))
        self._bullet.removeState(start)
        return motions

    @contextmanager
    def _changed(self, handles: Sequence[int], branch: Branch) -> Iterator[None]:
        """Apply what a branch changes besides the states, which a saved state does not include."""
        bullet, changes = self._bullet, []
        for handle, factor in zip(handles, branch.masses or [1.0] * len(handles), strict=True):
            info = bullet.getDynamicsInfo(handle, -1)
            changes.append((handle, "mass", info[0], factor))
            changes.append((handle, "restitution", info[5], branch.restitution))
        changes = [change for change in changes if change[-1] != 1]
        pairs = [[handles[k] for k in branch.passing]] if branch.passing else []
        for handle, name, value, factor in changes:
            bullet.changeDynamics(handle, -1, **{name: value * factor})
        for pair in pairs:
            bullet.setCollisionFilterPair(*pair, -1, -1, 0)
        yield
        for handle, name, value, _ in changes:
            bullet.changeDynamics(handle, -1, **{name: value})
        for pair in pairs:
            bullet.setCollisionFilterPair(*pair, -1, -1, 1)

    def _run(
        self,
        handles: Sequence[int],
        fixed: Sequence[int],
        world: WorldConfig,
        frames: int,
        in_air: Iterable[int] = (),
        is_rejected: Callable[[Touching], bool] = lambda touching: False,
    ) -> Motion:
        """Simulate from the present state of the bodies, which is the first of `frames` frames."""
        recorded = np.zeros((frames, len(handles), 13))
        recorded[0] = self._state(handles)
        in_air = {*in_air}
        touching: dict[tuple[int, int], list[int]] = defaultdict(list)
        landings, rejected = [], False
        step, list_contacts = self._bullet.stepSimulation, self._bullet.getContactPoints
        for frame in range(1, frames):
            pairs = set()
            # Bullet also lists points of pairs that have separated; contacts have a normal force.
            for _ in range(world.physics.substeps):
                step()
                for point in list_contacts():
                    if point[1] not in fixed and point[2] not in fixed and point[9] > 0:
                        pairs.add(tuple(sorted(map(handles.index, point[1:3]))))
                for k in list(in_air):
                    points = (p for surface in fixed for p in list_contacts(surface, handles[k]))
                    if any(point[9] > 0 for point in points):
                        in_air.remove(k)
                        landings.append(Landing(frame, k))
            for pair in sorted(pairs):
                touching[pair].append(frame)
            recorded[frame] = self._state(handles)
            if pairs and (rejected := is_rejected(touching)):
                recorded = recorded[: frame + 1]
                break
        return Motion(recorded, dict(touching), tuple(landings), rejected)

    def _reset(self, world: WorldConfig) -> list[int]:
        """Empty Bullet's world, add the floor and the parts, and return their handles."""
        bullet, physics = self._bullet, world.physics
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
        surfaces = [(physics.floor_friction, physics.floor_restitution)]
        fixed = [bullet.createMultiBody(0, bullet.createCollisionShape(bullet.GEOM_PLANE))]
        for part, box in zip(world.parts.values(), world_boxes(world), strict=True):
            form = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=box.half)
            fixed.append(bullet.createMultiBody(0, form, -1, box.position, box.quaternion))
            surfaces.append((part.friction, part.restitution))
        for handle, (friction, restitution) in zip(fixed, surfaces, strict=True):
            bullet.changeDynamics(handle, -1, lateralFriction=friction, restitution=restitution)
        return fixed

    def _add_body(self, body: Body, world: WorldConfig) -> int:
        on_floor = half_height(body.object.shape, body.scale)
        height = on_floor if body.height is None else body.height
        turn = self._bullet.getQuaternionFromEuler([0, 0, body.yaw])
        state = [*body.position, height, *turn, *body.velocity, 0.0, 0.0, 0.0, 0.0]
        return self._add(body.object, body.scale, state, world)

    def _add(
        self, scene_object: SceneObject, scale: float, state: Sequence[float], world: WorldConfig
    ) -> int:
        """Add an object with a state (13,), and return its handle."""
        bullet, physics = self._bullet, world.physics
        shape, material = scene_object.shape, scene_object.material
        radius = RADIUS * scale
        sizes = {
            "sphere": (bullet.GEOM_SPHERE, {"radius": radius}),
            "cube": (bullet.GEOM_BOX, {"halfExtents": [CUBE_HALF * scale] * 3}),
            "cylinder": (bullet.GEOM_CYLINDER, {"radius": radius, "height": 2 * radius}),
        }
        kind, size = sizes[shape]
        form = bullet.createCollisionShape(kind, **size)
        mass = getattr(world.objects.mass, material) * scale**3
        handle = bullet.createMultiBody(mass, form, -1, state[:3], state[3:7])
        # Sliding friction stops cubes and upright cylinders. With rolling friction at their
        # contacts, the solver takes a third longer.
        rolling_friction = physics.rolling_friction if shape == "sphere" else 0.0
        bullet.changeDynamics(
            handle,
            -1,
            lateralFriction=physics.object_friction,
            rollingFriction=rolling_friction,
            spinningFriction=rolling_friction,
            restitution=getattr(physics.restitution, material),
            linearDamping=0,
            angularDamping=0,
        )
        bullet.resetBaseVelocity(handle, state[7:10], state[10:13])
        return handle

    def _state(self, handles: Sequence[int]) -> np.ndarray:
        pose, velocity = self._bullet.getBasePositionAndOrientation, self._bullet.getBaseVelocity
        return np.array([list(chain(*pose(k), *velocity(k))) for k in handles])


@cache
def shared_simulator() -> Simulator:
    """Return the simulator of this process."""
    return Simulator()


def break_frames(fps: float) -> int:
    """Return the maximum number of frames without touch within a contact."""
    return max(1, round(LONGEST_BREAK * fps))


def has_repeated(touching: Touching, fps: float) -> bool:
    """Return whether any pair has a second, separate contact."""
    return any(
        after - before > break_frames(fps) + 1
        for frames in touching.values()
        for before, after in pairwise(frames)
    )
