"""The relations of a frame, and margins: how clearly a statement is true or false of a frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations, permutations
from math import dist, hypot, inf

from dynapix.teacher.predicates.facts import REGIONS, Relation
from dynapix.teacher.predicates.relations import (
    AGAINST,
    BETWEEN_ENDS,
    BETWEEN_OFFSET,
    COVER_DISTANCE,
    COVERED,
    EDGE,
    EDGES,
    EXTREMES,
    LEVEL,
    NEAR,
    NEARER,
    VALUES,
    Places,
)

FAINT = 0.01
"""Margin of a statement that is true or false because an object is hidden or missing. It is assumed
to be small: a reader may overlook this, or take another object for the missing one."""
REGION_INDICES = {value: (x, y) for y, row in enumerate(REGIONS) for x, value in enumerate(row)}
"""Column and row of each region."""
Margins = dict[str, float]
"""The margin of each value of a kind of relation. A value is true if its margin is not negative; at
a bound, where two are, the first of them is."""


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
    margin = MARGINS[kind](places, *objects)[value]
    if kind == "gap":
        return margin * _image_scale(places, objects)
    if kind == "nearer":
        a, b, c = objects
        return margin * _image_scale(places, (a, b), (a, c)) / (1 + 1 / NEARER)
    return margin


def find_relations(places: Places) -> set[Relation]:
    """Return the relations of the visible objects of a frame, normalized."""
    names = sorted(places.image)
    kinds = ("side", "height", "gap", "cover") if places.scale else ("side", "height", "cover")
    found: set[Relation] = set()
    for pair in combinations(names, 2):
        for kind in kinds:
            if (value := _find_value(kind, places, *pair)) is not None:
                found.add(Relation(kind, pair, value))
    for a in names:
        for b, c in combinations([name for name in names if name != a], 2):
            if _find_value("between", places, a, b, c) is not None:
                found.add(Relation("between", (a, b, c), "between"))
            value = _find_value("nearer", places, a, b, c)
            found.add(
                Relation("nearer", (a, b, c), value)
                if value is not None
                else Relation("nearer", (a, c, b), "nearer to")
            )
        extremes = _extreme_margins(places, a)
        found |= {Relation("extreme", (a,), value) for value, m in extremes.items() if m >= 0}
    return found


def find_changes(earlier: Places, later: Places, at_rest: set[str]) -> set[Relation]:
    """Return how the places of objects change that are visible at both of two frames, normalized.

    Args:
        at_rest: Objects that hardly move from the earlier to the later frame: they pass no object.
    """

    def find_values(kind: str, *objects: str) -> list[str | None]:
        return [_find_value(kind, places, *objects) for places in (earlier, later)]

    found: set[Relation] = set()
    both = sorted(earlier.image.keys() & later.image.keys())
    for a, b in permutations(both, 2):
        if a not in at_rest and {*find_values("side", a, b)} == {"left of", "right of"}:
            heights = find_values("height", a, b)
            value = "passes"
            if heights == ["below", "below"]:
                value = "crosses in front of"
            elif heights == ["above", "above"]:
                value = "crosses behind"
            found.add(Relation("passing", (a, b), value))
    for a in both:
        if a in at_rest:
            continue
        for b, c in combinations([name for name in both if name != a], 2):
            if find_values("between", a, b, c) == [None, "between"]:
                found.add(Relation("arrival", (a, b, c), "comes between"))
        reached = _edges(later.image[a]) - _edges(earlier.image[a])
        found |= {Relation("edge", (a,), f"reaches the {edge} edge") for edge in reached}
    return found


def _find_value(kind: str, places: Places, *objects: str) -> str | None:
    """Return the value of a kind that is true of visible objects in this order, if one is."""
    margins = MARGINS[kind](places, *objects)
    return next((value for value, margin in margins.items() if margin >= 0), None)


def _edges(place: tuple[float, float]) -> set[str]:
    x, y = place
    distances = zip(EDGES, (x, 1 - x, y, 1 - y), strict=True)
    return {edge for edge, distance in distances if distance < EDGE}


def _region_margin(place: tuple[float, float], region: str) -> float:
    """Return the distance from the nearest side of the region's cell; the image's edge is none."""
    distances = []
    for coordinate, cell in zip(place, REGION_INDICES[region], strict=True):
        distances += [
            coordinate - cell / 3 if cell > 0 else inf,
            (cell + 1) / 3 - coordinate if cell < 2 else inf,
        ]
    return min(distances)


def _order_margins(places: Places, a: str, b: str, axis: int) -> Margins:
    """Return margins of sides (axis 0) or heights (axis 1)."""
    first, level, last = VALUES[("side", "height")[axis]]
    apart = places.image[b][axis] - places.image[a][axis]
    return {first: apart - LEVEL, last: -apart - LEVEL, level: LEVEL - abs(apart)}


def _extreme_margins(places: Places, a: str) -> Margins:
    margins = {}
    for value, (axis, sign) in EXTREMES.items():
        others = [sign * place[axis] for name, place in places.image.items() if name != a]
        margins[value] = min(others, default=-inf) - sign * places.image[a][axis] - LEVEL
    return margins


def _between_margins(places: Places, a: str, b: str, c: str) -> Margins:
    """Return the distance of object a from the bounds of "between" the two others."""
    (x, y), one, other = places.image[a], places.image[b], places.image[c]
    dx, dy = other[0] - one[0], other[1] - one[1]
    px, py = x - one[0], y - one[1]
    length = hypot(dx, dy)
    if length == 0:
        return {"between": -inf}
    along, offset = (px * dx + py * dy) / length, abs(px * dy - py * dx) / length
    ends = BETWEEN_ENDS * length
    return {"between": min(along - ends, length - ends - along, BETWEEN_OFFSET * length - offset)}


def _gap_margins(places: Places, a: str, b: str) -> Margins:
    """Return margins on the ground."""
    size = (places.scale[a] + places.scale[b]) / 2
    apart = dist(places.ground[a], places.ground[b])
    against, near = (size * (1 + bound) for bound in (AGAINST, NEAR))
    return {
        "against": against - apart,
        "near": min(apart - against, near - apart),
        "apart from": apart - near,
    }


def _nearer_margins(places: Places, a: str, b: str, c: str) -> Margins:
    """Return margins on the ground, as multiples of (1 + 1 / NEARER)."""
    one, other = (dist(places.ground[a], places.ground[name]) for name in (b, c))
    return {
        "nearer to": other / NEARER - one,
        "as near to": min(one - other / NEARER, other - one / NEARER),
    }


def _cover_margins(places: Places, a: str, b: str) -> Margins:
    """Return which of two objects hides a part of the other, if one does. An object lower in the
    image is nearer to the camera."""
    (ax, ay), (bx, by) = places.image[a], places.image[b]
    front, back = (a, b) if ay > by else (b, a)
    is_close = ((ax - bx) ** 2 + (ay - by) ** 2) ** 0.5 < COVER_DISTANCE
    covers = is_close and places.fraction[back] < COVERED
    return {
        value: FAINT if covers and front == name else -FAINT
        for value, name in (("in front of", a), ("behind", b))
    }


MARGINS: dict[str, Callable[..., Margins]] = {
    "side": partial(_order_margins, axis=0),
    "height": partial(_order_margins, axis=1),
    "gap": _gap_margins,
    "cover": _cover_margins,
    "between": _between_margins,
    "nearer": _nearer_margins,
    "extreme": _extreme_margins,
}
"""For each kind of relation, the margins of its values for objects in the order of a statement."""


def _image_scale(places: Places, *pairs: tuple[str, str]) -> float:
    """Return the length in the image of a unit on the ground, measured between pairs of objects."""
    image, ground = (
        sum(dist(where[a], where[b]) for a, b in pairs) for where in (places.image, places.ground)
    )
    return image / ground if ground else 0.0
