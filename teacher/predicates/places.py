"""Predicates of places: regions, directions in the image, visibility and closeness."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from data.records import Scene
from data.world.displacement import MODEL_SIZE
from data.world.visibility import MIN_VISIBLE
from teacher.predicates.facts import COMPASS, OUT_OF_VIEW, REGIONS, Closeness

CONTACT = 0.4
"""Ground-plane distance (simulator units) at which two objects of scale 1 touch; it grows with the
mean scale of the objects."""
VERY_CLOSE = 0.6
"""Ground-plane distance (simulator units) below which two objects of scale 1 are very close; it
grows with their mean scale."""


def mean_scale(scene: Scene, i: int, j: int) -> float:
    """Return the mean scale of two objects."""
    return (scene.object_scales[i] + scene.object_scales[j]) / 2


def compass_direction(delta: np.ndarray) -> str | None:
    """Return the compass word of a displacement in the image (x right, y down); None for zero."""
    if np.hypot(*delta) < 1e-6:
        return None
    eighth = round(float(np.arctan2(delta[1], delta[0])) / (np.pi / 4))
    return COMPASS[eighth % 8]


def object_region(scene: Scene, frame: int, index: int) -> str:
    """Return the region of an object's center in a 3x3 grid, or "out of view"."""
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    return region_at(scene.image_positions[frame, index] / scene.image_size)


def region_at(place: ArrayLike) -> str:
    """Return the region of a place (x, y) in shares of the image's width and height."""
    column, row = np.clip(np.floor(np.multiply(place, 3)), 0, 2).astype(int)
    return REGIONS[row][column]


def square_position(scene: Scene, frame: int, index: int) -> np.ndarray:
    """Return the center (x, y) of an object in px of the square image."""
    return scene.image_positions[frame, index] * MODEL_SIZE / np.asarray(scene.image_size)


def object_sight(scene: Scene, frame: int, index: int) -> str:
    """Return whether an object is "shown", "hidden" (in view but covered) or "out of view"."""
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    # The fraction is NaN if the simulator does not record it; the object then counts as shown.
    return "hidden" if scene.visible_fraction[frame, index] <= MIN_VISIBLE else "shown"


def close_pairs(scene: Scene, target: int) -> tuple[Closeness, ...]:
    """Return the pairs of objects in view that are very close at a frame."""
    ground = scene.positions[target, :, :2]
    places = scene.image_positions[target]
    seen = [i for i in range(len(scene.objects)) if scene.in_view[target, i]]
    return tuple(
        Closeness(
            (scene.objects[i].noun_phrase, scene.objects[j].noun_phrase),
            region_at((places[i] + places[j]) / 2 / scene.image_size),
        )
        for i, j in combinations(seen, 2)
        if np.linalg.norm(ground[i] - ground[j]) < VERY_CLOSE * mean_scale(scene, i, j)
    )
