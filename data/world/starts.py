"""The ways in which a scene starts: `throw` and `strike`; `slide` is in `data.world.sliding`.

Each is a function that samples the initial states of given objects. It raises `RejectedError` if
the sample is unsuitable; `data.world.sampling` then samples the scene again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from data.records import SceneObject
from data.world.camera import Camera
from data.world.parts import surface_height, world_boxes
from data.world.physics import Body, Motion, shared_simulator
from data.world.shapes import RADIUS, half_height

if TYPE_CHECKING:
    from conf.schema import WorldConfig

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


class RejectedError(Exception):
    """A sampled scene is unsuitable. The message is one of a few reasons, which are counted."""


@dataclass(frozen=True)
class Sample:
    """The initial bodies of a scene, their motion, and the name of the scenario, if any."""

    bodies: list[Body]
    motion: Motion
    scenario: str = ""


@dataclass(frozen=True)
class SizedObject:
    """An object and its size, as a multiple of the standard size of its shape."""

    object: SceneObject
    scale: float


def throw(
    objects: Sequence[SizedObject], world: WorldConfig, camera: Camera, rng: np.random.Generator
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
            bodies.append(
                Body(each.object, place, rng.uniform(0, np.pi), height=on_part, scale=each.scale)
            )
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
    objects: Sequence[SizedObject], world: WorldConfig, camera: Camera, rng: np.random.Generator
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
        bodies.append(Body(each.object, place, rng.uniform(0, np.pi), scale=each.scale))
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
    margin = round(MARGIN * camera.magnification)
    return bool(
        depth > 1
        and margin < pixel[0] < camera.width - margin
        and margin < pixel[1] < camera.height - margin
    )


def length(vector: np.ndarray) -> float:
    """Return the length of a vector, with the same bits on every processor."""
    # Without an axis, numpy calls a BLAS function whose rounding depends on the processor, and a
    # difference of one bit in a starting velocity changes the scene after a few collisions.
    return float(np.linalg.norm(vector, axis=-1))


def unit_vector(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])
