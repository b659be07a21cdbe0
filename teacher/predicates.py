"""Predicates: qualitative facts from the oracle that a rationale may state.

They describe the scene at two frames, the cut and the target. The cut is the last frame that the
rationale treats as observed: the end of the prefix, or an earlier frame if a collision follows
shortly (see `find_cut`). No fact contains a number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from data.records import LETTERS, SPEED_BOUNDS, Candidate, Scene, SelectionItem
from data.world.visibility import MIN_VISIBLE

CUT_MARGIN = 12
"""Minimum number of frames from the cut to the next collision (paper, Rationale construction)."""
COURSE_FRAMES = 5
"""Number of frames up to the cut that determine headings and collision courses, and the minimum
number of observed frames (paper, Rationale construction)."""
STATIONARY = 0.05
"""Speed (simulator units/s) below which an object is stationary (paper, Rationale construction)."""
SPEEDS = ("slowly", "steadily", "quickly")
"""Words for speeds below each of the bounds of a scene; above these, it is VERY_FAST."""
VERY_FAST = "very quickly"
IMMINENT, SOON = 15, 40
"""Maximum numbers of frames from the cut to a collision that is "imminent", and to a collision that
comes "soon" (paper, Rationale construction)."""
CONTACT = 0.4
"""Ground-plane distance (simulator units) at which two objects of scale 1 touch; it grows with the
mean scale of the objects."""
COURSE_MARGIN = 0.1
"""Maximum gap (simulator units) between two objects on a collision course when they would pass."""
COURSE_HORIZON = 60
"""Number of frames over which straight paths are extrapolated."""
VERY_CLOSE = 0.6
"""Ground-plane distance (simulator units) below which two objects of scale 1 are very close; it
grows with their mean scale."""
IMAGE_SIZE = 336
"""Side (px) of the square image in which displacements are measured: the models' input size."""
STAYS, SHIFTS = 8.0, 60.0
"""Upper bounds of the displacement (px of the square image) of an object that "stays", and of one
that "shifts slightly". An object that moves further "moves across"."""
BORDER = 6.0
"""Displacement (px of the square image) below which a change of region is ignored."""
DISPLACED, CLEARLY = 12.0, 40.0
"""Displacements (px of the square image) from which an object counts as displaced, and as displaced
"clearly" rather than "slightly"."""

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

    `when` is "imminent", "soon" or "later"; None if they do not collide any more, or "unseen" if
    the scene ends while they still approach each other.
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
    collide from the cut to the target. `close` are pairs that are very close at the target.
    """

    instant: str
    moment: str
    objects: tuple[ObjectFacts, ...]
    entering: tuple[str, ...]
    leaving: tuple[str, ...]
    courses: tuple[Meeting, ...]
    contacts: tuple[Meeting, ...]
    close: tuple[Closeness, ...]


@dataclass(frozen=True)
class Predicates(Facts):
    """Facts about an item's scene and about its four candidates."""

    candidates: tuple[CandidateFacts, ...]

    @property
    def answer(self) -> str:
        return next(c.letter for c in self.candidates if c.agrees)


def find_cut(scene: Scene, start: int, stop: int) -> int | None:
    """Return the cut of the prefix [start, stop].

    The cut is `stop`, or the frame CUT_MARGIN frames before the first collision at or after `stop`,
    whichever is earlier. Returns None if fewer than COURSE_FRAMES frames remain up to the cut.
    """
    upcoming = [c.frame for c in scene.collisions if c.frame >= stop]
    cut = min([stop, *(frame - CUT_MARGIN for frame in upcoming)])
    return cut if cut - start + 1 >= COURSE_FRAMES else None


def extract_facts(
    scene: Scene, start: int, stop: int, target: int, moment: str = "at the target moment"
) -> Facts | None:
    """Return the facts for the prefix [start, stop] and a target frame; None if the prefix is too
    short (see `find_cut`). `moment` names the target in words."""
    cut = find_cut(scene, start, stop)
    if cut is None:
        return None
    objects = tuple(_object_facts(scene, i, cut, target) for i in range(len(scene.objects)))
    contacts = [c.objects for c in scene.collisions if cut < c.frame <= target]
    return Facts(
        instant="at the end of the observation" if cut == stop else "just before the contact",
        moment=moment,
        objects=objects,
        entering=tuple(o.object for o in objects if o.enters),
        leaving=tuple(o.object for o in objects if o.leaves),
        courses=tuple(_meeting(scene, p, cut) for p in find_collision_courses(scene, cut)),
        contacts=tuple(_meeting(scene, pair, cut) for pair in dict.fromkeys(contacts)),
        close=_close_pairs(scene, target),
    )


def extract_predicates(
    item: SelectionItem, scene: Scene, scene_of: Callable[[str], Scene]
) -> Predicates | None:
    """Return the predicates of an item; None if the prefix is too short (see `find_cut`).

    `scene_of` returns a scene by its id; it is called for candidates from other scenes.
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


def find_collision_courses(scene: Scene, cut: int) -> list[tuple[int, int]]:
    """Return the pairs that would collide within COURSE_HORIZON frames if both objects kept their
    velocity on the ground.

    The velocity is the mean over an object's last COURSE_FRAMES frames up to the cut, or over those
    since its last collision. Left out are pairs that collided with each other within these frames,
    pairs with an object that is hit at the cut, and pairs that hardly move relative to each other.
    """
    ground = scene.positions[:, :, :2]
    count = len(scene.objects)
    starts = [motion_start(scene, i, cut) for i in range(count)]
    met = {c.objects for c in scene.collisions if cut - COURSE_FRAMES < c.frame <= cut}
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
        contact = CONTACT * _mean_scale(scene, i, j)
        if np.linalg.norm(gap + time * closing) < contact + COURSE_MARGIN:
            pairs.append((i, j))
    return pairs


def _mean_scale(scene: Scene, i: int, j: int) -> float:
    return (scene.object_scales[i] + scene.object_scales[j]) / 2


def motion_start(scene: Scene, index: int, cut: int) -> int:
    """Return the first of the frames up to the cut that determine an object's motion: the last
    COURSE_FRAMES frames, or those since the object was hit."""
    hits = [c.frame for c in scene.collisions if index in c.objects and c.frame <= cut]
    return max([cut - COURSE_FRAMES + 1, *hits])


def _meeting(scene: Scene, pair: tuple[int, int], cut: int) -> Meeting:
    """Return a pair, and when it collides after the cut, if at all."""
    i, j = pair
    collisions = [c.frame for c in scene.collisions if set(c.objects) == {i, j}]
    frames = next((frame - cut for frame in collisions if frame > cut), None)
    if frames is not None:
        when = "imminent" if frames <= IMMINENT else "soon" if frames <= SOON else "later"
    else:
        gap = scene.positions[-1, j, :2] - scene.positions[-1, i, :2]
        closing = scene.velocities[-1, j, :2] - scene.velocities[-1, i, :2]
        approaches = np.dot(gap, closing) < -STATIONARY * np.linalg.norm(gap)
        when = "unseen" if approaches else None
    return Meeting((scene.objects[i].noun_phrase, scene.objects[j].noun_phrase), when)


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
    return _cell(scene, scene.image_positions[frame, index])


def _cell(scene: Scene, point: np.ndarray) -> str:
    cell = point / scene.image_size * 3
    column, row = np.clip(np.floor(cell), 0, 2).astype(int)
    return REGIONS[row][column]


def _position(scene: Scene, frame: int, index: int) -> np.ndarray:
    """Return the center (x, y) of an object in px of the square image."""
    return scene.image_positions[frame, index] * IMAGE_SIZE / np.asarray(scene.image_size)


def _sight(scene: Scene, frame: int, index: int) -> str:
    if not scene.in_view[frame, index]:
        return OUT_OF_VIEW
    # The fraction is NaN if the simulator does not record it; the object then counts as shown.
    return "hidden" if scene.visible_fraction[frame, index] <= MIN_VISIBLE else "shown"


def _object_facts(scene: Scene, index: int, cut: int, target: int) -> ObjectFacts:
    sight, target_sight = _sight(scene, cut, index), _sight(scene, target, index)
    speed = heading = travel = None
    if sight != OUT_OF_VIEW:
        speed = _speed(scene, index, cut)
        heading = object_heading(scene, index, motion_start(scene, index, cut), cut)
    shift = _position(scene, target, index) - _position(scene, cut, index)
    distance = float(np.hypot(*shift))
    if sight == OUT_OF_VIEW == target_sight:
        extent = "unseen"
    elif distance < STAYS:
        extent = "stays"
    else:
        extent = "shifts slightly" if distance < SHIFTS else "moves across"
        travel = compass_direction(shift)
    return ObjectFacts(
        object=scene.objects[index].noun_phrase,
        region=object_region(scene, cut, index),
        sight=sight,
        speed=speed,
        heading=heading,
        target_region=object_region(scene, target, index),
        target_sight=target_sight,
        extent=extent,
        travel=travel,
    )


def object_heading(scene: Scene, index: int, since: int, frame: int) -> str | None:
    """Return the compass word of an object's displacement from the frame `since` to `frame`; None
    if the object is stationary at `frame` or has not moved."""
    if _speed(scene, index, frame) == "stationary":
        return None
    return compass_direction(_position(scene, frame, index) - _position(scene, since, index))


def _speed(scene: Scene, index: int, frame: int) -> str:
    speed = float(np.linalg.norm(scene.velocities[frame, index]))
    if speed < STATIONARY:
        return "stationary"
    words = zip(SPEEDS, scene.speed_bounds or SPEED_BOUNDS, strict=True)
    return next((word for word, bound in words if speed < bound), VERY_FAST)


def _close_pairs(scene: Scene, target: int) -> tuple[Closeness, ...]:
    ground = scene.positions[target, :, :2]
    places = scene.image_positions[target]
    seen = [i for i in range(len(scene.objects)) if scene.in_view[target, i]]
    return tuple(
        Closeness(
            (scene.objects[i].noun_phrase, scene.objects[j].noun_phrase),
            _cell(scene, (places[i] + places[j]) / 2),
        )
        for i, j in combinations(seen, 2)
        if np.linalg.norm(ground[i] - ground[j]) < VERY_CLOSE * _mean_scale(scene, i, j)
    )


def _candidate_facts(
    letter: str,
    scene: Scene,
    target: int,
    candidate: Candidate,
    scene_of: Callable[[str], Scene],
) -> CandidateFacts:
    other = scene if candidate.scene_id == scene.scene_id else scene_of(candidate.scene_id)
    frame = candidate.frame
    in_target, in_candidate = (
        {key: k for k, key in enumerate(s.object_keys)} for s in (scene, other)
    )
    ranked: list[tuple[tuple[bool, bool, float], Difference]] = []
    for key in {**in_target, **in_candidate}:
        name, i, j = key[0].noun_phrase, in_target.get(key), in_candidate.get(key)
        expected = i is not None and _sight(scene, target, i) == "shown"
        visible = j is not None and _sight(other, frame, j) == "shown"
        if expected != visible:
            difference = Difference(name, "missing" if expected else "extra")
            ranked.append(((True, True, float(IMAGE_SIZE)), difference))
        elif i is not None and j is not None:
            shift = _position(other, frame, j) - _position(scene, target, i)
            distance = float(np.hypot(*shift))
            region = object_region(other, frame, j)
            if region != object_region(scene, target, i):
                bound, difference = BORDER, Difference(name, "region", region=region)
            else:
                extent = "clearly" if distance >= CLEARLY else "slightly"
                heading = compass_direction(shift)
                difference = Difference(name, "displaced", heading=heading, extent=extent)
                bound = DISPLACED
            ranked.append(((visible and distance >= bound, visible, distance), difference))
    ranked.sort(key=lambda entry: entry[0], reverse=True)
    # If every difference is below its bound, name the largest: the candidate is not the target.
    differences = tuple(d for (clear, *_), d in ranked if clear) or (ranked[0][1],)
    other_objects = in_target.keys() != in_candidate.keys()
    return CandidateFacts(letter, False, other_objects, differences)
