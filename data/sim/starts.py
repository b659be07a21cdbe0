"""The ways in which a scene starts: `slide`, `throw` and `strike`.

Each is a function that samples the initial states of given bodies. It raises `RejectedError` if the
sample is unsuitable; `data.sim.sampling` then samples the scene again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.parts import surface_height, world_boxes
from dynapix.data.sim.physics import Body, Motion, Touching, has_repeated, shared_simulator
from dynapix.data.sim.shapes import BOUNDING_RADIUS, RADIUS, half_height

COLLISIONS = {2: 0.63, 3: 0.33, 4: 0.04}
"""Probabilities of the intended number of collisions, from a sample of CLEVRER's release."""
PLACEMENTS = 40
"""Number of attempts to place an object before the scene is sampled again."""
EARLIEST, TAIL = 15, 17
"""First frame of a planned collision, and number of frames at the end of a scene without one."""
CLEAR = 0.7
"""Minimum distance (simulator units) of an object at rest from the paths of other objects, for
scale 1."""
SLOW = 0.3
"""Minimum speed (simulator units/s) of an object at its planned collision."""
ROW_STEP = (0.75, 1.1)
"""Range of distances between neighbours in a row of objects of scale 1, simulator units."""
DROP_SPEED = (0.2, 0.8)
"""Range of the horizontal speed of an object that falls on a row, simulator units per second."""
MARGIN = 20 / 105
"""Width of the image's border in which no object may start, as a fraction of the length in px of a
simulator unit in the middle of the image. In the world of CLEVRER, it is 20 px."""
CLEARANCE = 0.05
"""Height above a part from which an object at rest is released, simulator units."""

OFF_SCREEN = "an object starts outside the image"
OVERLAP = "objects overlap at the start"
NO_COLLISION = "no objects collide"
NO_PLACE = "no place is found where an object overlaps no other and collides as planned"


class RejectedError(Exception):
    """A sampled scene is unsuitable. The message is one of a few reasons, which are counted."""


@dataclass(frozen=True)
class Sample:
    """The initial bodies of a scene, their motion, and the name of the scenario, if any."""

    bodies: list[Body]
    motion: Motion
    scenario: str = ""


def slide(
    objects: Sequence[Body], world: WorldConfig, camera: Camera, rng: np.random.Generator
) -> Sample:
    """Sample bodies of which the first slides into the view.

    Each further body is placed so that it collides with an earlier one, until the scene has its
    intended number of collisions; the others rest and touch no other body. A placement by which a
    pair touches at the start or collides twice is rejected.
    """
    return _Slide(world, camera, rng).sample(objects)


@dataclass(frozen=True)
class _Slide:
    world: WorldConfig
    camera: Camera
    rng: np.random.Generator

    def sample(self, objects: Sequence[Body]) -> Sample:
        intended = int(self.rng.choice(list(COLLISIONS), p=list(COLLISIONS.values())))
        goal = min(intended, self.world.start.max_collisions or intended)
        bodies = [self._entering(objects[0])]
        motion = shared_simulator().simulate(bodies, self.world)
        if motion.touching_at_start:
            raise RejectedError(OVERLAP)
        for added in objects[1:]:
            attempts = (self._try_body(bodies, motion, added, goal) for _ in range(PLACEMENTS))
            extended = next(filter(None, attempts), None)
            if extended is None:
                raise RejectedError(NO_PLACE)
            bodies, motion = extended
        return Sample(bodies, motion)

    def _body(self, added: Body, place: np.ndarray, velocity: Sequence[float] = (0, 0)) -> Body:
        """Return a body at a place on the floor with a random yaw; by default at rest."""
        yaw = self.rng.uniform(0, 2 * np.pi)
        return replace(added, position=place, yaw=yaw, velocity=velocity)

    def _entering(self, added: Body) -> Body:
        """Sample a body that moves from far away towards the middle."""
        rng, start = self.rng, self.world.start
        middle = np.array(start.middle)
        bearing = rng.uniform(0, 2 * np.pi)
        begin = middle + rng.uniform(*start.distance) * unit_vector(bearing)
        goal = middle + rng.uniform(-start.spread, start.spread, 2)
        direction = (goal - begin) / length(goal - begin)
        return self._body(added, begin, rng.uniform(*start.speed) * direction)

    def _try_body(
        self, bodies: list[Body], motion: Motion, added: Body, goal: int
    ) -> tuple[list[Body], Motion] | None:
        """Add a body that collides with another body or, once there are `goal` collisions, with
        none. Return all bodies and their motion, or None if the sampled body does not fit."""
        is_colliding = len(motion.touching) < goal
        body = (self._colliding if is_colliding else self._resting)(added, motion)
        if body is None:
            return None
        extended = [*bodies, body]
        # A body at rest that stays clear of the others need not be simulated with them.
        combined = None if is_colliding else self._combine(motion, body)
        most = self.world.start.max_collisions or math.inf

        def is_rejected(contacts: Touching) -> bool:
            collides = any(len(bodies) in pair for pair in contacts)
            is_repeated = has_repeated(contacts, self.world.physics.fps)
            return is_repeated or len(contacts) > most or (collides and not is_colliding)

        simulate = shared_simulator().simulate
        result = combined or simulate(extended, self.world, is_rejected=is_rejected)
        if result.touching_at_start or result.is_rejected:
            return None
        collides = any(len(bodies) in pair for pair in result.touching)
        return (extended, result) if collides == is_colliding else None

    def _combine(self, motion: Motion, body: Body) -> Motion | None:
        """Add the motion of a body that touches no other body; return None if it may touch one.

        Bullet solves groups of bodies that do not touch separately, so the result is bit-identical
        to a simulation of all bodies.
        """
        alone = shared_simulator().simulate([body], self.world)
        if alone.touching_at_start:
            return None
        distance = np.linalg.norm(motion.positions - alone.positions, axis=-1)
        # Objects at this distance at every frame never touch: between two frames, the distance
        # falls by at most the margin.
        speed = np.linalg.norm(motion.velocities, axis=-1).max()
        margin = max(0.2, speed / self.world.physics.fps)
        scale = self.world.objects.scale[1]
        if distance.min() < 2 * max(BOUNDING_RADIUS.values()) * scale + margin:
            return None
        return replace(motion, states=np.concatenate([motion.states, alone.states], axis=1))

    def _colliding(self, added: Body, motion: Motion) -> Body | None:
        """Sample a body that should collide with another body on screen: at rest in its path, or
        moving towards its future position. Returns None if the sample is unsuitable."""
        rng, physics, start = self.rng, self.world.physics, self.world.start
        other = int(rng.integers(motion.positions.shape[1]))
        frame = int(rng.integers(EARLIEST, physics.frames - TAIL))
        place = motion.positions[frame, other, :2] + rng.normal(0, 0.1, 2)
        if not self._is_on_screen(place, added):
            return None
        if rng.random() < start.at_rest:
            is_slow = length(motion.velocities[frame, other]) < SLOW
            return None if is_slow else self._body(added, place)
        seconds, deceleration = frame / physics.fps, physics.friction_deceleration
        speed = rng.uniform(*start.speed)
        if speed - deceleration * seconds < SLOW:
            return None
        travel = speed * seconds - deceleration * seconds**2 / 2
        direction = unit_vector(rng.uniform(0, 2 * np.pi))
        return self._body(added, place - travel * direction, speed * direction)

    def _resting(self, added: Body, motion: Motion) -> Body | None:
        """Sample a body at rest on screen; return None if it is off screen or near another's
        path."""
        rng, (x_min, y_min, x_max, y_max) = self.rng, self.world.start.area
        place = np.array([rng.uniform(x_min, x_max), rng.uniform(y_min, y_max)])
        distance = np.linalg.norm(motion.positions[..., :2] - place, axis=-1).min()
        if distance <= CLEAR * self.world.objects.scale[1] or not self._is_on_screen(place, added):
            return None
        return self._body(added, place)

    def _is_on_screen(self, place: np.ndarray, added: Body) -> bool:
        return is_on_screen(place, half_height("sphere", added.scale), self.camera)


def throw(
    objects: Sequence[Body], world: WorldConfig, camera: Camera, rng: np.random.Generator
) -> Sample:
    """Sample objects above the floor or above a part that move towards the middle.

    With probability `start.at_rest`, an object starts at rest near the middle instead.
    """
    start, boxes = world.start, world_boxes(world)
    bodies = []
    for each in objects:
        is_resting = start.at_rest > 0 and rng.random() < start.at_rest
        if is_resting:
            place = _near_middle(world, rng)
        else:
            place = rng.uniform(start.area[:2], start.area[2:])
        surface = surface_height(boxes, place)
        if is_resting:
            height = half_height(each.object.shape, each.scale)
            on_part = surface + height + CLEARANCE if surface else None
            bodies.append(replace(each, position=place, yaw=rng.uniform(0, np.pi), height=on_part))
            height += surface
        else:
            height = surface + rng.uniform(*start.height)
        if not is_on_screen(place, height, camera):
            raise RejectedError(OFF_SCREEN)
        if is_resting:
            continue
        toward = _near_middle(world, rng) - place
        velocity = rng.uniform(*start.speed) * toward / length(toward)
        bodies.append(Body(each.object, place, rng.uniform(0, np.pi), velocity, height, each.scale))
    return Sample(bodies, shared_simulator().simulate(bodies, world))


def strike(
    objects: Sequence[Body], world: WorldConfig, camera: Camera, rng: np.random.Generator
) -> Sample:
    """Sample a row of objects at rest, and an object that strikes the first object of the row.

    The striking object slides along the row (scenario Collide) or falls (scenario Drop).
    """
    start = world.start
    last, *row = objects
    # The row is roughly perpendicular to the view: otherwise objects would hide each other.
    bearing = rng.choice([-1, 1]) * np.pi / 2 + rng.uniform(-0.7, 0.7)
    place = rng.uniform(start.area[:2], start.area[2:])
    first, bodies = place, []
    for each in row:
        if not is_on_screen(place, RADIUS, camera):
            raise RejectedError(OFF_SCREEN)
        bodies.append(replace(each, position=place, yaw=rng.uniform(0, np.pi)))
        step = rng.uniform(*ROW_STEP) * max(world.objects.scale[1], 1.0)
        place = place + step * unit_vector(bearing + rng.normal(0, 0.15))
    if rng.random() < 0.5:
        scenario, height = "Collide", None
        begin = first - rng.uniform(*start.distance) * unit_vector(bearing + rng.normal(0, 0.05))
        velocity = first - begin
        velocity *= rng.uniform(*start.speed) / length(velocity)
    else:
        scenario = "Drop"
        begin = first + rng.normal(0, 0.25, 2)
        height = rng.uniform(*start.height)
        if not is_on_screen(begin, height, camera):
            raise RejectedError(OFF_SCREEN)
        velocity = rng.uniform(*DROP_SPEED) * unit_vector(rng.uniform(0, 2 * np.pi))
    bodies.append(Body(last.object, begin, rng.uniform(0, np.pi), velocity, height, last.scale))
    return Sample(bodies, shared_simulator().simulate(bodies, world), scenario)


def _near_middle(world: WorldConfig, rng: np.random.Generator) -> np.ndarray:
    spread = world.start.spread
    return np.array(world.start.middle) + rng.uniform(-spread, spread, 2)


def is_on_screen(place: np.ndarray, height: float, camera: Camera) -> bool:
    """Return whether a point above a ground position is on screen, with a margin of `MARGIN`."""
    pixel, depth = camera.project(np.array([*place, height]))
    margin, size = round(MARGIN * camera.magnification), np.array([camera.width, camera.height])
    return bool(depth > 1 and ((margin < pixel) & (pixel < size - margin)).all())


def length(vector: np.ndarray) -> float:
    """Return the length of a vector, with the same bits on every processor."""
    # Without an axis, numpy calls a BLAS function whose rounding depends on the processor, and a
    # difference of one bit in a starting velocity changes the scene after a few collisions.
    return float(np.linalg.norm(vector, axis=-1))


def unit_vector(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])
