"""What a rationale may say: qualitative facts read from the oracle, with no number in any of them.

A fact is taken at the cut, an instant at or before the prefix's end that lies clear of the next
collision, and at the target. The thresholds below are the only numbers, and none leaves this file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np

from data.records import FPS, LETTERS, Candidate, Collision, Scene, SelectionItem

CUT_MARGIN = 12
"""Frames between the cut and the first collision (paper, Rationale construction)."""
COURSE_FRAMES = 5
"""Frames before the cut that give headings and collision courses; also the shortest prefix
(paper, Rationale construction)."""
STATIONARY = 0.05
"""Simulator units a second under which an object is stationary (paper, Rationale construction)."""
SPEEDS = ((0.6, "slowly"), (1.5, "steadily"), (3.0, "quickly"))
"""Upper bounds (simulator units a second) of the speed words; anything faster is VERY_FAST."""
VERY_FAST = "very quickly"
IMMINENT, SOON = 15, 40
"""Frames from the cut within which an event is imminent, or soon (paper, Rationale
construction)."""
CONTACT = 0.4
"""Ground-plane distance (simulator units) at which two objects of radius 0.2 touch."""
COURSE_MARGIN = 0.1
"""Simulator units by which a straight-line pass may miss and still be a collision course."""
COURSE_HORIZON = 60
"""Frames that a straight line is followed to judge a collision course."""
VERY_CLOSE = 0.6
"""Ground-plane distance (simulator units) under which a pair is very close."""
SHOWN = 0.05
"""Visible fraction at and under which an object in view is hidden."""
VIEW = 336
"""Side (px) of the square image in which displacements are judged: what a model is shown."""
STAYS, SHIFTS = 8.0, 60.0
"""Bounds (px at 336) of "stays" and "shifts slightly"; anything further "moves across"."""
BORDER = 6.0
"""Displacement (px at 336) under which a change of region is only a border crossed."""
DISPLACED, CLEARLY = 12.0, 40.0
"""Displacements (px at 336) from which an object is off, and clearly so."""

COMPASS = (
    "east",
    "southeast",
    "south",
    "southwest",
    "west",
    "northwest",
    "north",
    "northeast",
)
"""Clockwise from the image's x axis; y points down, so south is down."""
REGIONS = (
    ("near the top-left", "near the top", "near the top-right"),
    ("near the left", "near the center", "near the right"),
    ("near the bottom-left", "near the bottom", "near the bottom-right"),
)
OUT_OF_VIEW = "out of view"


@dataclass(frozen=True)
class ObjectFacts:
    """One object at the cut and at the target.

    `sight` and `target_sight` are "shown", "hidden" (in view but covered) or "out of view";
    `speed` is "stationary" or a speed word, None where the object is out of view at the cut, for
    nobody sees how it moves; `heading` and `travel` are compass words of the motion at the cut and
    from cut to target, None where there is none to speak of or, at a contact, none to see yet;
    `extent` says how far it goes from cut to target, "unseen" where it is out of view at both.
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
    """A pair and when it collides, from the cut: imminent, soon, later, None for never, or
    "unseen" where the clip ends with the pair still closing."""

    objects: tuple[str, str]
    when: str | None


@dataclass(frozen=True)
class Closeness:
    """A pair that is very close at the target, and the region that it is around."""

    objects: tuple[str, str]
    region: str


@dataclass(frozen=True)
class Difference:
    """How a candidate shows one object otherwise than the target.

    `kind` is "region" (shown in `region`), "displaced" (right region, off by `extent`, slightly or
    clearly, toward `heading`), "missing" (should be seen and is not) or "extra" (is seen and
    should not be).
    """

    object: str
    kind: str
    region: str | None = None
    heading: str | None = None
    extent: str | None = None


@dataclass(frozen=True)
class CandidateFacts:
    """A candidate's layout against the target's: it agrees, or differs in these objects, the
    most telling first. `other_objects` is true where it shows a different set of objects."""

    letter: str
    agrees: bool
    other_objects: bool
    differences: tuple[Difference, ...]


@dataclass(frozen=True)
class Facts:
    """A scene at the cut and at the target: `instant` and `moment` name the two in words.

    `entering` and `leaving` are the objects that come into view and go out of it from cut to
    target. `courses` are pairs on a collision course at the cut, `contacts` pairs that collide
    between cut and target, whether or not they were on a course.
    """

    instant: str
    moment: str
    objects: tuple[ObjectFacts, ...]
    entering: tuple[str, ...]
    leaving: tuple[str, ...]
    courses: tuple[Meeting, ...]
    contacts: tuple[Meeting, ...]
    close: tuple[Closeness, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and booleans, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Predicates(Facts):
    """Facts of an item's scene and of its four candidates."""

    candidates: tuple[CandidateFacts, ...]

    @property
    def answer(self) -> str:
        return next(c.letter for c in self.candidates if c.agrees)


def find_cut(scene: Scene, start: int, stop: int) -> int | None:
    """The frame that facts are taken at for the prefix [start, stop]: its end, or CUT_MARGIN
    frames before the first collision from there on; None if that leaves too short a prefix."""
    upcoming = [c.frame for c in scene.collisions if c.frame >= stop]
    cut = min([stop, *(frame - CUT_MARGIN for frame in upcoming)])
    return cut if cut - start + 1 >= COURSE_FRAMES else None


def extract_facts(
    scene: Scene, start: int, stop: int, target: int, moment: str = "at the target moment"
) -> Facts | None:
    """Facts for a prefix and a target frame; None if the cut leaves too short a prefix."""
    cut = find_cut(scene, start, stop)
    if cut is None:
        return None
    names = [o.phrase for o in scene.objects]
    objects = tuple(_object_facts(scene, i, cut, target) for i in range(len(names)))
    contacts = [c for c in scene.collisions if cut < c.frame <= target]
    return Facts(
        instant="at the end of the observation" if cut == stop else "just before the contact",
        moment=moment,
        objects=objects,
        entering=tuple(o.object for o in objects if o.enters),
        leaving=tuple(o.object for o in objects if o.leaves),
        courses=tuple(
            Meeting((names[i], names[j]), _outcome(scene, i, j, cut))
            for i, j in courses(scene, cut)
        ),
        contacts=tuple(
            Meeting((names[i], names[j]), _when(contacts, i, j, cut))
            for i, j in dict.fromkeys(c.objects for c in contacts)
        ),
        close=_close_pairs(scene, target),
    )


def extract_predicates(
    item: SelectionItem, scene: Scene, scene_of: Callable[[str], Scene]
) -> Predicates | None:
    """Predicates of an item; None if its prefix is too short after the cut.

    `scene_of` gives the scenes that cross-scene candidates come from.
    """
    moment = {"future": "at the collision", "contact": "just after the collision"}.get(
        item.framing or "", "at the target moment"
    )
    facts = extract_facts(scene, item.prefix_start, item.prefix_stop, item.target_frame, moment)
    if facts is None:
        return None
    candidates = tuple(
        CandidateFacts(letter, True, False, ())
        if letter == item.letter
        else _candidate_facts(letter, scene, item.target_frame, candidate, scene_of)
        for letter, candidate in zip(LETTERS, item.candidates, strict=True)
    )
    return Predicates(**vars(facts), candidates=candidates)


def courses(scene: Scene, cut: int) -> list[tuple[int, int]]:
    """Pairs that straight lines through the last COURSE_FRAMES frames bring together, each line
    through the frames since its object's last contact; none that has just met."""
    ground = scene.positions[:, :, :2]
    count = len(scene.objects)
    starts = [free_since(scene, i, cut) for i in range(count)]
    met = {c.objects for c in scene.collisions if cut - COURSE_FRAMES < c.frame <= cut}
    step = [(ground[cut, i] - ground[starts[i], i]) / max(cut - starts[i], 1) for i in range(count)]
    pairs = []
    for i, j in combinations(range(count), 2):
        if (i, j) in met or cut in (starts[i], starts[j]):
            continue
        apart, closing = ground[cut, j] - ground[cut, i], step[j] - step[i]
        speed = float(np.linalg.norm(closing))
        if speed * FPS < STATIONARY or np.dot(apart, closing) >= 0:
            continue
        time = min(-float(np.dot(apart, closing)) / speed**2, COURSE_HORIZON)
        if np.linalg.norm(apart + time * closing) < CONTACT + COURSE_MARGIN:
            pairs.append((i, j))
    return pairs


def free_since(scene: Scene, index: int, cut: int) -> int:
    """The first of the COURSE_FRAMES frames up to the cut that an object passed without a contact
    after it: its motion is one motion from there on. The cut itself where it has just been hit."""
    hits = [c.frame for c in scene.collisions if index in c.objects and c.frame <= cut]
    return max([cut - COURSE_FRAMES + 1, *hits])


def _outcome(scene: Scene, i: int, j: int, cut: int) -> str | None:
    when = _when(scene.collisions, i, j, cut)
    return "unseen" if when is None and _closing_at_end(scene, i, j) else when


def _closing_at_end(scene: Scene, i: int, j: int) -> bool:
    apart = scene.positions[-1, j, :2] - scene.positions[-1, i, :2]
    closing = scene.velocities[-1, j, :2] - scene.velocities[-1, i, :2]
    return bool(np.dot(apart, closing) < -STATIONARY * np.linalg.norm(apart))


def compass(delta: np.ndarray) -> str | None:
    """The compass word of an image-plane displacement (x right, y down); None for no movement."""
    if np.hypot(*delta) < 1e-6:
        return None
    eighth = round(float(np.arctan2(delta[1], delta[0])) / (np.pi / 4))
    return COMPASS[eighth % 8]


def object_region(scene: Scene, frame: int, index: int) -> str:
    """The cell of the 3x3 grid that an object's centre lies in, in words, or "out of view"."""
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    return _cell(scene, scene.image_positions[frame, index])


def _cell(scene: Scene, point: np.ndarray) -> str:
    cell = point / scene.image_size * 3
    column, row = np.clip(np.floor(cell), 0, 2).astype(int)
    return REGIONS[row][column]


def _sight(scene: Scene, frame: int, index: int) -> str:
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    return "shown" if scene.visible_fraction[frame, index] > SHOWN else "hidden"


def _object_facts(scene: Scene, index: int, cut: int, target: int) -> ObjectFacts:
    pixels = scene.image_positions[:, index] * VIEW / np.asarray(scene.image_size)
    sight, target_sight = _sight(scene, cut, index), _sight(scene, target, index)
    speed = _speed(scene, index, cut) if sight != OUT_OF_VIEW else None
    moving = speed not in (None, "stationary")
    travelled = pixels[target] - pixels[cut]
    extent = _extent(travelled) if {sight, target_sight} != {OUT_OF_VIEW} else "unseen"
    return ObjectFacts(
        object=scene.objects[index].phrase,
        region=object_region(scene, cut, index),
        sight=sight,
        speed=speed,
        heading=object_heading(scene, index, free_since(scene, index, cut), cut)
        if moving
        else None,
        target_region=object_region(scene, target, index),
        target_sight=target_sight,
        extent=extent,
        travel=None if extent in ("stays", "unseen") else compass(travelled),
    )


def object_heading(scene: Scene, index: int, since: int, frame: int) -> str | None:
    """The compass word of the way that an object has gone since an earlier frame; None where it
    does not move."""
    if _speed(scene, index, frame) == "stationary":
        return None
    pixels = scene.image_positions[:, index] * VIEW / np.asarray(scene.image_size)
    return compass(pixels[frame] - pixels[since])


def _speed(scene: Scene, index: int, frame: int) -> str:
    speed = float(np.linalg.norm(scene.velocities[frame, index]))
    if speed < STATIONARY:
        return "stationary"
    return next((word for bound, word in SPEEDS if speed < bound), VERY_FAST)


def _extent(travelled: np.ndarray) -> str:
    distance = float(np.hypot(*travelled))
    return (
        "stays" if distance < STAYS else "shifts slightly" if distance < SHIFTS else "moves across"
    )


def _when(
    collisions: tuple[Collision, ...] | list[Collision], i: int, j: int, cut: int
) -> str | None:
    ahead = [c.frame - cut for c in collisions if set(c.objects) == {i, j} and c.frame > cut]
    if not ahead:
        return None
    return "imminent" if ahead[0] <= IMMINENT else "soon" if ahead[0] <= SOON else "later"


def _close_pairs(scene: Scene, target: int) -> tuple[Closeness, ...]:
    ground = scene.positions[target, :, :2]
    places = scene.image_positions[target]
    seen = [i for i in range(len(scene.objects)) if scene.in_view[target, i]]
    return tuple(
        Closeness(
            (scene.objects[i].phrase, scene.objects[j].phrase),
            _cell(scene, (places[i] + places[j]) / 2),
        )
        for i, j in combinations(seen, 2)
        if np.linalg.norm(ground[i] - ground[j]) < VERY_CLOSE
    )


def _candidate_facts(
    letter: str,
    scene: Scene,
    target: int,
    candidate: Candidate,
    scene_of: Callable[[str], Scene],
) -> CandidateFacts:
    other = scene if candidate.scene_id == scene.scene_id else scene_of(candidate.scene_id)
    here = {o.phrase: i for i, o in enumerate(scene.objects)}
    there = {o.phrase: i for i, o in enumerate(other.objects)}
    found: list[tuple[float, Difference]] = []
    small: list[tuple[bool, float, Difference]] = []
    for name in {**here, **there}:
        i, j = here.get(name), there.get(name)
        expected = i is not None and _sight(scene, target, i) == "shown"
        shown = j is not None and _sight(other, candidate.frame, j) == "shown"
        if expected != shown:
            found.append((float(VIEW), Difference(name, "missing" if expected else "extra")))
        elif i is not None and j is not None:
            difference, distance = _displacement(scene, target, i, other, candidate.frame, j)
            if shown and distance >= (BORDER if difference.kind == "region" else DISPLACED):
                found.append((distance, difference))
            else:
                small.append((shown, distance, difference))
    found.sort(key=lambda pair: -pair[0])
    if not found:
        # Two candidates always differ somewhere; the largest difference is named even if faint.
        found = [max(small, key=lambda entry: entry[:2])[1:]]
    return CandidateFacts(letter, False, set(here) != set(there), tuple(d for _, d in found))


def _displacement(
    scene: Scene, target: int, i: int, other: Scene, frame: int, j: int
) -> tuple[Difference, float]:
    name = scene.objects[i].phrase
    wanted = scene.image_positions[target, i] * VIEW / np.asarray(scene.image_size)
    actual = other.image_positions[frame, j] * VIEW / np.asarray(other.image_size)
    distance = float(np.hypot(*(actual - wanted)))
    region = object_region(other, frame, j)
    if region != object_region(scene, target, i):
        return Difference(name, "region", region=region), distance
    extent = "clearly" if distance >= CLEARLY else "slightly"
    return Difference(name, "displaced", heading=compass(actual - wanted), extent=extent), distance
