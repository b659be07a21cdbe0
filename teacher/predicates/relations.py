"""Relations: how the objects of a frame lie to each other, in words without measures.

A relation has a kind, objects and a value:

| kind | objects | values |
|---|---|---|
| side | a, b | left of, right of, aligned with |
| height | a, b | above, below, level with |
| gap | a, b | against, near, apart from |
| cover | a, b | in front of, behind |
| between | a, b, c | between: a is between b and c |
| nearer | a, b, c | nearer to: a is nearer to b than to c; as near to: as near to b as to c |
| extreme | a | leftmost, rightmost, topmost, lowest |
| passing | a, b | passes, crosses in front of, crosses behind |
| arrival | a, b, c | comes between |
| edge | a | reaches the left edge, and right, top and bottom |

The last three describe the change from an earlier frame. Sides and heights are those of the centres
in the image; gaps are measured on the ground. A scene that does not record contacts has no gaps,
and which object is nearer is measured in its image plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from dynapix.conf.schema.world import RADIUS
from dynapix.data.oracle.displacement import MODEL_SIZE
from dynapix.data.records import Scene
from dynapix.teacher.predicates.facts import Relation
from dynapix.teacher.predicates.places import object_sight

OPPOSITES = {
    "left of": "right of", "above": "below", "in front of": "behind",
}  # fmt: skip
OPPOSITES |= {value: key for key, value in OPPOSITES.items()}
"""The value of a relation of two objects if they change places; other values stay."""
EDGES = ("left", "right", "top", "bottom")
EXTREMES = {"leftmost": (0, 1), "rightmost": (0, -1), "topmost": (1, 1), "lowest": (1, -1)}
"""Axis of each extreme, and the sign with which the coordinate of the extreme object is the
smallest."""
VALUES = {
    "side": ("left of", "aligned with", "right of"),
    "height": ("above", "level with", "below"),
    "gap": ("against", "near", "apart from"),
    "cover": ("in front of", "behind"),
    "between": ("between",),
    "nearer": ("nearer to", "as near to"),
    "extreme": tuple(EXTREMES),
    "passing": ("passes", "crosses in front of", "crosses behind"),
    "arrival": ("comes between",),
    "edge": tuple(f"reaches the {edge} edge" for edge in EDGES),
}
"""The values of each kind of relation."""
KINDS = {value: kind for kind, values in VALUES.items() for value in values}
KINDS |= {"heavier than": "weight", "lighter than": "weight"}
"""The kind of each value. Weights are not relations of a frame, but the reader reads them alike."""
CHANGES = ("passing", "arrival", "edge")
"""Kinds of relations that describe a change from the cut to the target."""
SYMMETRIC = {"side", "height", "gap", "cover"}
"""Kinds that are true of two objects in either order, with the opposite value."""
EXTENTS = ("slightly", "clearly", "far")
"""How far off an object is in a candidate."""
LEVEL = 0.04
"""Share of the image's width or height below which two objects are aligned or level, and by which
the leftmost object must lie to the left of all others."""
AGAINST, NEAR = 0.15, 1.0
"""Gaps, as shares of an object's width, below which two objects are against and near each other."""
BETWEEN_ENDS, BETWEEN_OFFSET = 0.2, 0.25
"""An object between two others divides their distance, of which each part has at least the first
share. The second is its largest distance from the line through them, as a share of theirs."""
NEARER = 1.25
"""a is nearer to b than to c if it is at least this many times as far from c as from b."""
COVERED, COVER_DISTANCE = 0.9, 0.12
"""An object is partly hidden if its visible fraction is below the first. An object that is lower in
the image, and nearer than the second (share of the width), is then in front of it."""
EDGE = 0.06
"""Share of the image's width or height below which an object has reached the edge."""
DISPLACED, CLEARLY, FAR = 12 / MODEL_SIZE, 40 / MODEL_SIZE, 0.25
"""Distances of an object in a candidate from its place at the target, as shares of the image, from
which it is slightly, clearly and far off."""
BOUNDS = (
    *(LEVEL, AGAINST, NEAR, BETWEEN_ENDS, BETWEEN_OFFSET, NEARER),
    *(COVERED, COVER_DISTANCE, EDGE, DISPLACED, CLEARLY, FAR),
)
"""All of these, which the records of rationales name by a hash."""


def describe_distance(distance: float) -> str | None:
    """Return how far an object is off if its place is at a distance (share of the image's width)
    from the expected place: slightly, clearly or far; None if it counts as being there."""
    if distance < DISPLACED:
        return None
    if distance >= FAR:
        return "far"
    return "clearly" if distance >= CLEARLY else "slightly"


def flip_relation(relation: Relation) -> Relation:
    """Return the same statement about two objects in the other order."""
    kind, objects, value = relation
    return Relation(kind, objects[::-1], OPPOSITES.get(value, value))


def normalize_relation(relation: Relation) -> Relation:
    """Return the same statement with its interchangeable objects in alphabetical order."""
    kind, objects, value = relation
    if kind in SYMMETRIC and objects[0] > objects[1]:
        return flip_relation(relation)
    if (kind in ("between", "arrival") or value == "as near to") and objects[1] > objects[2]:
        return Relation(kind, (objects[0], objects[2], objects[1]), value)
    return relation


def find_topic(statement: Relation, relations: Sequence[Relation]) -> Relation | None:
    """Return the relation between the same objects in the same respect, with the same subject.

    For "a is nearer to b than to c", this may be "a is nearer to c than to b" or "a is as near to b
    as to c".
    """
    kind, objects, _ = normalize_relation(statement)
    if kind == "nearer":
        subject, *others = objects
        same = (r for r in relations if r.kind == kind and r.objects[0] == subject)
        return next((r for r in same if {*r.objects[1:]} == {*others}), None)
    if kind not in SYMMETRIC:
        return None
    for relation in relations:
        if relation[:2] == (kind, objects):
            return relation if objects == statement.objects else flip_relation(relation)
    return None


class Places(NamedTuple):
    """The visible objects of a frame by name: their places in the image as shares of its width and
    height, their places on the ground in widths of an object of scale 1, their widths in the same
    unit, and their visible fractions. Objects that look alike are left out, since words cannot tell
    them apart. Where contacts are not recorded, there are no widths: the gaps are unknown."""

    image: dict[str, tuple[float, float]]
    ground: dict[str, tuple[float, float]]
    scale: dict[str, float]
    fraction: dict[str, float]

    @classmethod
    def from_frame(cls, scene: Scene, frame: int) -> Places:
        """Return the places of the visible objects of a frame."""
        image = (scene.image_positions[frame] / scene.image_size).tolist()
        ground = (scene.positions[frame, :, :2] / (2 * RADIUS)).tolist()
        fraction = scene.visible_fraction[frame].tolist()
        names = [each.noun_phrase for each in scene.objects]
        seen = {
            name: k
            for k, name in enumerate(names)
            if names.count(name) == 1 and object_sight(scene, frame, k) == "shown"
        }
        return cls(
            {name: tuple(image[k]) for name, k in seen.items()},
            {name: tuple(ground[k]) for name, k in seen.items()},
            {
                name: scene.object_radii[k] / RADIUS
                for name, k in seen.items()
                if scene.records_contacts
            },
            {name: fraction[k] for name, k in seen.items()},
        )
