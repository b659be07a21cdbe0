"""Predicates: qualitative facts from the oracle that a rationale may state.

They describe the scene at two frames, the cut and the target. The cut is the last frame that the
rationale treats as observed: the end of the prefix, or an earlier frame if a collision follows
shortly (see `teacher.predicates.motion.find_cut`). No fact contains a number.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from dynapix.teacher.predicates.relations import Places

SPEEDS = ("slowly", "steadily", "quickly")
"""Words for speeds below each of the bounds of a scene; above these, it is VERY_FAST."""
VERY_FAST = "very quickly"
COMPASS = ("east", "southeast", "south", "southwest", "west", "northwest", "north", "northeast")
"""Directions in the image, clockwise from the x axis, which points right; south is down."""
REGIONS = (
    ("near the top-left", "near the top", "near the top-right"),
    ("near the left", "near the center", "near the right"),
    ("near the bottom-left", "near the bottom", "near the bottom-right"),
)
OUT_OF_VIEW = "out of view"


@dataclass(frozen=True)
class ObjectFacts:
    """One object at the cut and at the target.

    `sight` and `target_sight` are "shown", "hidden" (in view but covered) or "out of view". `speed`
    is "stationary" or a word for the speed at the cut, and `heading` the compass word of the motion
    at the cut. Both are None if the object is out of view; `heading` is also None if the object is
    stationary or is hit at the cut. `extent` describes the displacement from the cut to the target;
    it is "unseen" if the object is out of view at both. `travel` is the compass word of this
    displacement; None if the object stays or is unseen.
    """

    object: str
    region: str
    sight: str
    speed: str | None
    heading: str | None
    target_region: str
    target_sight: str
    extent: str
    travel: str | None

    @property
    def enters(self) -> bool:
        return self.sight == OUT_OF_VIEW != self.target_sight

    @property
    def leaves(self) -> bool:
        return self.sight != OUT_OF_VIEW == self.target_sight


@dataclass(frozen=True)
class Meeting:
    """Two objects, and when they collide after the cut.

    `when` is "imminent", "soon" or "later"; None if they do not collide after the cut, or "unseen"
    if the scene ends while they still approach each other.
    """

    objects: tuple[str, str]
    when: str | None


@dataclass(frozen=True)
class Closeness:
    """Two objects that are very close at the target, and the region midway between them."""

    objects: tuple[str, str]
    region: str


@dataclass(frozen=True)
class Difference:
    """One object that a candidate shows differently from the target.

    `kind` is "region" (the candidate shows the object in another region, `region`), "displaced"
    (it shows the object in the same region, but displaced toward `heading` by an `extent` of
    "slightly" or "clearly"), "missing" (the object is visible only in the target) or "extra" (it is
    visible only in the candidate).
    """

    object: str
    kind: str
    region: str | None = None
    heading: str | None = None
    extent: str | None = None


@dataclass(frozen=True)
class CandidateFacts:
    """A candidate compared with the target.

    `agrees` is true for the target itself. `differences` are sorted, the largest first.
    `other_objects` is true if the candidate's scene has a different set of objects.
    """

    letter: str
    agrees: bool
    other_objects: bool
    differences: tuple[Difference, ...]


@dataclass(frozen=True)
class Facts:
    """A scene at the cut and at the target; `instant` names the cut in words, `moment` the target.

    `entering` and `leaving` are the objects that come into view and go out of view from the cut to
    the target. `courses` are pairs on a collision course at the cut. `contacts` are all pairs that
    collide from the cut to the target. `close` are pairs that are very close at the target. These
    three are unknown, and empty, if `records_contacts` is false. `heavier` are pairs of which the
    first object is known to be heavier, by its material. `later` are pairs that meet at the cut or
    after the target: no rationale says so, but a text that does is not false.
    """

    instant: str
    moment: str
    objects: tuple[ObjectFacts, ...]
    entering: tuple[str, ...]
    leaving: tuple[str, ...]
    courses: tuple[Meeting, ...]
    contacts: tuple[Meeting, ...]
    close: tuple[Closeness, ...]
    records_contacts: bool = field(default=True, kw_only=True)
    heavier: tuple[tuple[str, str], ...] = field(default=(), kw_only=True)
    later: tuple[tuple[str, str], ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class Predicates(Facts):
    """Facts about an item's scene and about its four candidates."""

    candidates: tuple[CandidateFacts, ...]

    @property
    def answer(self) -> str:
        return next(c.letter for c in self.candidates if c.agrees)


class Relation(NamedTuple):
    """A statement about one to three objects of a frame.

    `teacher.predicates.relations` lists the kinds and their values. The statements of a `View` also
    have the kinds "region", with the values of `ObjectFacts`, and "sight", with the value "unseen".
    """

    kind: str
    objects: tuple[str, ...]
    value: str


@dataclass(frozen=True)
class View:
    """A frame as a reader of a rationale sees it, with what has changed since the cut.

    `objects` are the item's objects, with this frame as the target; an object that the frame's
    scene lacks is out of view. `relations` are normalized and sorted. `places` are the places of
    the frame's visible objects.
    """

    letter: str
    objects: tuple[ObjectFacts, ...]
    close: tuple[Closeness, ...]
    relations: tuple[Relation, ...]
    places: Places

    @cached_property
    def statements(self) -> frozenset[Relation]:
        """All statements that are true of the frame: its relations, the regions of its visible
        objects, and that the others are unseen."""
        names = [o.object for o in self.objects]
        places = {
            Relation("region", (o.object,), o.target_region)
            if o.target_sight == "shown"
            else Relation("sight", (o.object,), "unseen")
            for o in self.objects
            if names.count(o.object) == 1
        }
        return frozenset(self.relations) | places


@dataclass(frozen=True)
class RelationalPredicates(Predicates):
    """Predicates with relations.

    `left_to_right` are the names of the objects in the order of their places along the image's
    width at the cut, `observed` are the relations at the cut, and `views` are the candidates as a
    reader sees them. That of the answer is the view of the target. `paths` are the distances that
    objects move in the image from the cut to the target, in shares of its width and height; only
    objects that are visible at both have one.
    """

    left_to_right: tuple[str, ...]
    paths: dict[str, float]
    observed: tuple[Relation, ...]
    views: tuple[View, ...]

    @property
    def target(self) -> View:
        return next(view for view in self.views if view.letter == self.answer)

    def without_relations(self) -> Predicates:
        """Return the predicates of the paper's vocabulary."""
        return Predicates(**{f.name: getattr(self, f.name) for f in fields(Predicates)})
