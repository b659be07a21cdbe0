"""Predicates of motion: the cut, speeds, headings, collision courses and meetings."""

from __future__ import annotations

from itertools import combinations
from math import hypot

import numpy as np

from dynapix.data.oracle.events import collisions_in, next_collision, touching_pairs
from dynapix.data.records import SPEED_BOUNDS, Scene
from dynapix.teacher.predicates.facts import SPEEDS, VERY_FAST, Meeting
from dynapix.teacher.predicates.places import (
    compass_direction,
    contact_distance,
    square_displacement,
)

CUT_MARGIN = 12
"""Minimum number of frames from the cut to the next collision (paper, Rationale construction)."""
COURSE_FRAMES = 5
"""Number of frames up to the cut that determine headings and collision courses, and the minimum
number of observed frames (paper, Rationale construction)."""
STATIONARY = 0.05
"""Speed (simulator units/s) below which an object is stationary (paper, Rationale construction)."""
IMMINENT, SOON = 15, 40
"""Maximum numbers of frames from the cut to a collision that is "imminent", and to a collision that
comes "soon" (paper, Rationale construction)."""
COURSE_MARGIN = 0.25
"""Maximum gap between two objects on a collision course when they would pass, in units of their
contact distance: 0.1 simulator units for two objects of scale 1."""
COURSE_HORIZON = 60
"""Number of frames over which straight paths are extrapolated."""


def find_cut(scene: Scene, start: int, stop: int) -> int | None:
    """Return the cut of the prefix [start, stop].

    The cut is `stop`, or the frame CUT_MARGIN frames before the first collision at or after `stop`,
    whichever is earlier. Returns None if fewer than COURSE_FRAMES frames remain up to the cut.
    """
    upcoming = next_collision(scene, stop - 1)
    cut = min(stop, upcoming.frame - CUT_MARGIN) if upcoming else stop
    return cut if cut - start + 1 >= COURSE_FRAMES else None


def find_collision_courses(scene: Scene, cut: int) -> list[tuple[int, int]]:
    """Return the pairs that would collide within COURSE_HORIZON frames if both objects kept their
    velocity on the ground.

    The velocity is the mean over an object's last COURSE_FRAMES frames up to the cut, or over those
    since its last collision. Left out are pairs that touch within these frames, pairs with an
    object that is hit at the cut, and pairs that hardly move relative to each other. No pairs are
    found in a scene that does not record contacts.
    """
    if not scene.records_contacts:
        return []
    ground = scene.positions[:, :, :2]
    count = len(scene.objects)
    starts = [motion_start(scene, i, cut) for i in range(count)]
    met = touching_pairs(scene, cut - COURSE_FRAMES + 1, cut)
    step = [(ground[cut, i] - ground[starts[i], i]) / max(cut - starts[i], 1) for i in range(count)]
    pairs = []
    for i, j in combinations(range(count), 2):
        if (i, j) in met or cut in (starts[i], starts[j]):
            continue
        gap, closing = ground[cut, j] - ground[cut, i], step[j] - step[i]
        speed = float(np.linalg.norm(closing))
        if speed * scene.fps < STATIONARY or np.dot(gap, closing) >= 0:
            continue
        time = min(-float(np.dot(gap, closing)) / speed**2, COURSE_HORIZON)
        nearest = np.linalg.norm(gap + time * closing)
        if nearest < (1 + COURSE_MARGIN) * contact_distance(scene, i, j):
            pairs.append((i, j))
    return pairs


def motion_start(scene: Scene, index: int, cut: int) -> int:
    """Return the first of the frames up to the cut that determine an object's motion: the last
    COURSE_FRAMES frames, or those since the object was hit."""
    hits = [c.frame for c in collisions_in(scene, 1, cut) if index in c.objects]
    return max([cut - COURSE_FRAMES + 1, *hits])


def describe_meeting(scene: Scene, pair: tuple[int, int], cut: int) -> Meeting:
    """Return a pair, and when it collides after the cut, if at all."""
    i, j = pair
    ahead = [c for c in collisions_in(scene, cut + 1, scene.frames) if c.objects == (i, j)]
    if ahead:
        frames = ahead[0].frame - cut
        when = "imminent" if frames <= IMMINENT else "soon" if frames <= SOON else "later"
    else:
        gap = scene.positions[-1, j, :2] - scene.positions[-1, i, :2]
        closing = scene.velocities[-1, j, :2] - scene.velocities[-1, i, :2]
        approaches = np.dot(gap, closing) < -STATIONARY * np.linalg.norm(gap)
        when = "unseen" if approaches else None
    return Meeting((scene.objects[i].noun_phrase, scene.objects[j].noun_phrase), when)


def object_heading(scene: Scene, index: int, since: int, frame: int) -> str | None:
    """Return the compass word of an object's displacement from the frame `since` to `frame`; None
    if the object is stationary at `frame` or has not moved."""
    if object_speed(scene, index, frame) == "stationary":
        return None
    return compass_direction(square_displacement(scene, since, index, scene, frame, index))


def object_speed(scene: Scene, index: int, frame: int) -> str:
    """Return the word for an object's speed at a frame."""
    speed = hypot(*scene.velocities[frame, index].tolist())
    if speed < STATIONARY:
        return "stationary"
    words = zip(SPEEDS, scene.speed_bounds or SPEED_BOUNDS, strict=True)
    return next((word for word, bound in words if speed < bound), VERY_FAST)
