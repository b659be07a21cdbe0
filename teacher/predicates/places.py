"""Predicates of places: regions, directions in the image, visibility and closeness."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import atan2, dist, hypot, pi

from dynapix.data.oracle.displacement import MODEL_SIZE
from dynapix.data.oracle.visibility import MIN_VISIBLE
from dynapix.data.records import Scene
from dynapix.teacher.predicates.facts import COMPASS, OUT_OF_VIEW, REGIONS, Closeness

VERY_CLOSE = 1.5
"""Ground-plane distance below which two objects are very close, in units of their contact
distance: 0.6 simulator units for two objects of scale 1."""


def contact_distance(scene: Scene, i: int, j: int) -> float:
    """Return the ground-plane distance (simulator units) at which two objects touch."""
    return scene.object_radii[i] + scene.object_radii[j]


# Scenes have a few objects, and an item has four candidates. On so few numbers, Python's floats are
# faster than arrays.


def compass_direction(delta: Sequence[float]) -> str | None:
    """Return the compass word of a displacement in the image (x right, y down); None for zero."""
    if hypot(*delta) < 1e-6:
        return None
    x, y = delta
    return COMPASS[round(atan2(y, x) / (pi / 4)) % 8]


def object_region(scene: Scene, frame: int, index: int) -> str:
    """Return the region of an object's center in a 3x3 grid, or "out of view"."""
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    (x, y), (width, height) = scene.image_positions[frame, index].tolist(), scene.image_size
    return region_at((x / width, y / height))


def region_at(place: Sequence[float]) -> str:
    """Return the region of a place (x, y) in shares of the image's width and height."""
    column, row = (min(max(int(3 * share), 0), 2) for share in place)
    return REGIONS[row][column]


def square_position(scene: Scene, frame: int, index: int) -> tuple[float, float]:
    """Return the center (x, y) of an object in px of the square image."""
    (x, y), (width, height) = scene.image_positions[frame, index].tolist(), scene.image_size
    return x * MODEL_SIZE / width, y * MODEL_SIZE / height


def square_displacement(
    scene: Scene, frame: int, index: int, later: Scene, later_frame: int, later_index: int
) -> tuple[float, float]:
    """Return the displacement (x, y) of an object from a frame to another one, which may be of
    another scene, in px of the square image."""
    x, y = square_position(scene, frame, index)
    later_x, later_y = square_position(later, later_frame, later_index)
    return later_x - x, later_y - y


def object_sight(scene: Scene, frame: int, index: int) -> str:
    """Return whether an object is "shown", "hidden" (in view but covered) or "out of view"."""
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    # The fraction is NaN if the simulator does not record it; the object then counts as shown.
    return "hidden" if scene.visible_fraction[frame, index] <= MIN_VISIBLE else "shown"


def close_pairs(scene: Scene, target: int) -> tuple[Closeness, ...]:
    """Return the pairs of objects in view that are very close at a frame; none in a scene that does
    not record contacts."""
    if not scene.records_contacts:
        return ()
    ground = scene.positions[target, :, :2].tolist()
    places = (scene.image_positions[target] / scene.image_size).tolist()
    seen = [i for i in range(len(scene.objects)) if scene.in_view[target, i]]
    return tuple(
        Closeness(
            (scene.objects[i].noun_phrase, scene.objects[j].noun_phrase),
            region_at([(a + b) / 2 for a, b in zip(places[i], places[j], strict=True)]),
        )
        for i, j in combinations(seen, 2)
        if dist(ground[i], ground[j]) < VERY_CLOSE * contact_distance(scene, i, j)
    )
