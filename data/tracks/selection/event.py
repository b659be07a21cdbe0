"""The event family: which frame shows the scene at, or just after, a collision.

Framing *future*: the prefix ends `gap` frames before the collision and the target is the event
frame. Framing *contact*: the prefix ends at the collision and the target is `gap` frames later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from data.records import Candidate, FrameRef, Scene
from data.tracks.selection.distractors import (
    DistractorPicker,
    Draft,
    outside_prefix,
    scene_candidates,
    visible_objects,
)
from data.world.displacement import object_match_scores

QUESTION = "Which image is closest to the correct future state of the whole scene?"
PREFIX_STEP = 20
"""Frames from the prefix's start to its end."""
TAIL = 10
"""Least number of frames between the target and the clip's end."""
OFFSETS = (16, 32, 48)
"""Frames on either side of the target at which same-scene distractors lie."""
ELSEWHERE = 24
"""Other scenes looked at for cross-scene distractors."""


@dataclass(frozen=True)
class EventCell:
    framing: str
    distractors: str
    gap: int


CELLS = {
    "future_cross_gap10": EventCell("future", "cross_scene", 10),
    "future_offset_gap10": EventCell("future", "same_offset", 10),
    "future_match_gap10": EventCell("future", "same_obj_match", 10),
    "future_match_gap5": EventCell("future", "same_obj_match", 5),
    "contact_cross": EventCell("contact", "cross_scene", 10),
    "contact_offset": EventCell("contact", "same_offset", 10),
    "contact_match": EventCell("contact", "same_obj_match", 10),
}
"""The paper's seven subtypes (paper, Table "The seven event-anchored subtypes")."""


@dataclass(frozen=True)
class EventTiming:
    """Where a collision at frame `event` puts an item's prefix and target."""

    event: int
    start: int
    stop: int
    target: int


def event_timings(scene: Scene, cell: EventCell) -> Iterator[EventTiming]:
    """The moments of a scene that the cell can ask about, in order of time."""
    for event in dict.fromkeys(c.frame for c in scene.collisions):
        stop = event - cell.gap if cell.framing == "future" else event
        moment = EventTiming(event, stop - PREFIX_STEP, stop, stop + cell.gap)
        if moment.start >= 0 and moment.target <= scene.frames - 1 - TAIL:
            yield moment


def draft(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> Draft | None:
    """An item of the cell around one of the scene's collisions, tried in a random order."""
    cell = CELLS[subtype]
    found = list(event_timings(scene, cell))
    for k in rng.permutation(len(found)):
        moment = found[k]
        pool = wrong_frames(cell, scene, moment, rng, picker)
        across = cell.distractors == "cross_scene"
        picked = picker.pick(
            FrameRef(scene.scene_id, moment.target),
            pool,
            visible_objects(scene, (moment.start, moment.stop)),
            None if across else int(rng.integers(4)),
        )
        if picked is None:
            continue
        return Draft(
            scene,
            "event",
            subtype,
            QUESTION,
            (moment.start, moment.stop),
            moment.target,
            *picked,
            {
                "event_frame": moment.event,
                "framing": cell.framing,
                "distractors": cell.distractors,
                "gap": cell.gap,
            },
        )
    return None


def wrong_frames(
    cell: EventCell,
    scene: Scene,
    moment: EventTiming,
    rng: np.random.Generator,
    picker: DistractorPicker,
) -> Iterable[Candidate]:
    """Distractors of the cell's source, in the order in which they are wanted: the scene at
    offsets on either side, the scene's frames most alike to the target, or other scenes at such a
    moment of their own."""
    target, prefix = moment.target, (moment.start, moment.stop)
    if cell.distractors == "same_offset":
        pool = [f for o in OFFSETS for f in (target - o, target + o) if 0 <= f < scene.frames]
        return scene_candidates(
            scene, rng.permutation(outside_prefix(pool, prefix)), cell.distractors
        )
    if cell.distractors == "same_obj_match":
        alike = np.argsort(object_match_scores(scene, target), kind="stable")
        wrong = outside_prefix(alike[alike != target], prefix)
        return scene_candidates(scene, wrong, cell.distractors)
    return (
        Candidate(other.scene_id, there.target, cell.distractors)
        for other in picker.others(scene, rng, ELSEWHERE)
        for there in list(event_timings(other, cell))[:1]
    )
