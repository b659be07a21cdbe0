"""Margins: how clearly a statement is true or false of a frame."""

from __future__ import annotations

from math import dist, inf

from dynapix.teacher.predicates.facts import REGIONS, Relation
from dynapix.teacher.predicates.relations import (
    AGAINST,
    EXTREMES,
    LEVEL,
    NEAR,
    NEARER,
    VALUES,
    Places,
    between_margin,
    find_covering,
)

FAINT = 0.01
"""Margin of a statement that is true or false because an object is hidden or missing. It is assumed
to be small: a reader may overlook this, or take another object for the missing one."""
REGION_INDICES = {value: (x, y) for y, row in enumerate(REGIONS) for x, value in enumerate(row)}
"""Column and row of each region."""


def measure_margin(statement: Relation, places: Places) -> float:
    """Return how far a frame is from the point at which a statement changes between true and false,
    as a share of the image's width or height: not negative if the statement is true of the frame,
    negative if it is false.

    A statement about regions, sides, heights or extremes stays true, or false, if one of its
    objects moves by less than this in the image. For "between", this holds if the object in the
    middle moves. For gaps and "nearer to", which are measured on the ground, this holds
    approximately. Margins of what is hidden, or hides another object, are constant (`FAINT`).

    Args:
        statement: Any statement of a frame, but no change since the cut.
    """
    kind, objects, value = statement
    seen = all(name in places.image for name in objects)
    if kind == "sight":
        # The only statement of this kind is that an object cannot be seen.
        return -FAINT if seen else FAINT
    if not seen:
        return -FAINT
    if kind == "region":
        return _region_margin(places.image[objects[0]], value)
    if kind in ("side", "height"):
        axis = ("side", "height").index(kind)
        first, second = (places.image[name][axis] for name in objects)
        return _order_margin(second - first, VALUES[kind].index(value))
    if kind == "extreme":
        return _extreme_margin(objects[0], value, places)
    if kind == "between":
        return between_margin(*(places.image[name] for name in objects))
    if kind == "gap":
        return _gap_margin(*objects, value, places)
    if kind == "nearer":
        return _nearer_margin(*objects, value, places)
    return _cover_margin(*objects, value, places)


def _region_margin(place: tuple[float, float], region: str) -> float:
    """Return the distance from the nearest side of the region's cell; the image's edge is none."""
    distances = []
    for coordinate, cell in zip(place, REGION_INDICES[region], strict=True):
        distances += [
            coordinate - cell / 3 if cell > 0 else inf,
            (cell + 1) / 3 - coordinate if cell < 2 else inf,
        ]
    return min(distances)


def _order_margin(difference: float, position: int) -> float:
    """Return the margin of a word for the order along an axis.

    Args:
        difference: Coordinate of the second object less that of the first.
        position: 0 if the first object comes first, 1 if the two are level, 2 if it comes last.
    """
    return (difference - LEVEL, LEVEL - abs(difference), -difference - LEVEL)[position]


def _extreme_margin(name: str, value: str, places: Places) -> float:
    axis, sign = EXTREMES[value]
    others = [sign * place[axis] for other, place in places.image.items() if other != name]
    return min(others, default=-inf) - sign * places.image[name][axis] - LEVEL


def _gap_margin(a: str, b: str, value: str, places: Places) -> float:
    size = (places.scale[a] + places.scale[b]) / 2
    apart = dist(places.ground[a], places.ground[b])
    against, near = (size * (1 + bound) for bound in (AGAINST, NEAR))
    margin = {
        "against": against - apart,
        "near": min(apart - against, near - apart),
        "apart from": apart - near,
    }[value]
    return margin * _image_scale(places, (a, b))


def _nearer_margin(a: str, b: str, c: str, value: str, places: Places) -> float:
    one, other = (dist(places.ground[a], places.ground[name]) for name in (b, c))
    if value == "nearer to":
        margin = other / NEARER - one
    else:
        margin = min(one - other / NEARER, other - one / NEARER)
    return margin * _image_scale(places, (a, b), (a, c)) / (1 + 1 / NEARER)


def _cover_margin(a: str, b: str, value: str, places: Places) -> float:
    front = a if value == "in front of" else b
    return FAINT if find_covering(places, a, b) == front else -FAINT


def _image_scale(places: Places, *pairs: tuple[str, str]) -> float:
    """Return the length in the image of a unit on the ground, measured between pairs of objects."""
    image, ground = (
        sum(dist(where[a], where[b]) for a, b in pairs) for where in (places.image, places.ground)
    )
    return image / ground if ground else 0.0
