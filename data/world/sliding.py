"""The start `slide`: objects slide on the floor and collide, in the manner of CLEVRER."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from data.world.camera import Camera
from data.world.physics import Body, Contacts, Motion, has_repeated, shared_simulator
from data.world.shapes import BOUNDING_RADIUS, half_height
from data.world.starts import (
    OVERLAP,
    RejectedError,
    Sample,
    SizedObject,
    is_on_screen,
    length,
    unit_vector,
)

if TYPE_CHECKING:
    from conf.schema import WorldConfig

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

NO_PLACE = "no place is found where an object overlaps no other and collides as planned"


def slide(
    objects: Sequence[SizedObject], world: WorldConfig, camera: Camera, rng: np.random.Generator
) -> Sample:
    """Sample bodies whose first body slides into the view.

    Each further body is placed so that it collides with an earlier body, until the scene has its
    intended number of collisions; the others rest and touch no other body. A placement by which a
    pair touches at the start or collides twice is rejected.
    """
    return _Slide(world, camera, rng).sample(objects)


@dataclass(frozen=True)
class _Slide:
    world: WorldConfig
    camera: Camera
    rng: np.random.Generator

    def sample(self, objects: Sequence[SizedObject]) -> Sample:
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

    def _body(
        self, added: SizedObject, place: np.ndarray, velocity: np.ndarray | None = None
    ) -> Body:
        """Return a body at a place on the floor with a random yaw; by default at rest."""
        velocity = np.zeros(2) if velocity is None else velocity
        yaw = self.rng.uniform(0, 2 * np.pi)
        return Body(added.object, place, yaw, velocity, scale=added.scale)

    def _entering(self, added: SizedObject) -> Body:
        """Sample a body that moves from far away towards the middle."""
        rng, start = self.rng, self.world.start
        middle = np.array(start.middle)
        bearing = rng.uniform(0, 2 * np.pi)
        begin = middle + rng.uniform(*start.distance) * unit_vector(bearing)
        goal = middle + rng.uniform(-start.spread, start.spread, 2)
        direction = (goal - begin) / length(goal - begin)
        return self._body(added, begin, rng.uniform(*start.speed) * direction)

    def _try_body(
        self, bodies: list[Body], motion: Motion, added: SizedObject, goal: int
    ) -> tuple[list[Body], Motion] | None:
        """Add a body that collides with another body or, once there are `goal` collisions, with
        none.

        Returns:
            All bodies and their motion, or None if the sampled body does not fit.
        """
        is_colliding = len(motion.collisions) < goal
        body = (self._colliding if is_colliding else self._resting)(added, motion)
        if body is None:
            return None
        extended = [*bodies, body]
        # A body at rest usually stays clear of the others, and then need not be simulated with
        # them.
        combined = None if is_colliding else self._combine(motion, body)
        most = self.world.start.max_collisions or math.inf

        def is_rejected(contacts: Contacts) -> bool:
            collides = any(len(bodies) in pair for pair in contacts)
            return has_repeated(contacts) or len(contacts) > most or (collides and not is_colliding)

        result = combined or shared_simulator().simulate(
            extended, self.world, is_rejected=is_rejected
        )
        if result.touching_at_start or result.is_rejected:
            return None
        collides = any(len(bodies) in c.objects for c in result.collisions)
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

    def _colliding(self, added: SizedObject, motion: Motion) -> Body | None:
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

    def _resting(self, added: SizedObject, motion: Motion) -> Body | None:
        """Sample a body at rest on screen; return None if it is off screen or near another's
        path."""
        rng, (x_min, y_min, x_max, y_max) = self.rng, self.world.start.area
        place = np.array([rng.uniform(x_min, x_max), rng.uniform(y_min, y_max)])
        distance = np.linalg.norm(motion.positions[..., :2] - place, axis=-1).min()
        if distance <= CLEAR * self.world.objects.scale[1] or not self._is_on_screen(place, added):
            return None
        return self._body(added, place)

    def _is_on_screen(self, place: np.ndarray, added: SizedObject) -> bool:
        return is_on_screen(place, half_height("sphere", added.scale), self.camera)
