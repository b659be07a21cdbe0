"""The event family: which frame shows the scene at, or just after, a collision.

Framing *future*: the prefix ends `gap` frames before the collision and the target is the event
frame. Framing *contact*: the prefix ends at the collision and the target is `gap` frames later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from data.records import Candidate, FrameRef, Scene, SelectionItem
from data.tracks.selection.distractors import (
    DistractorPicker,
    new_item,
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
"""Offsets of same-scene distractors from the target, in frames on either side."""
CROSS_SCENES = 24
"""Other scenes sampled for cross-scene distractors."""


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
    """Frames of an item around an event: the event, the prefix's first and last, the target."""

    event: int
    start: int
    stop: int
    target: int


def event_timings(scene: Scene, cell: EventCell) -> Iterator[EventTiming]:
    """The timings of a scene's collisions that leave room for prefix and target, in order."""
    for event in dict.fromkeys(c.frame for c in scene.collisions):
        stop = event - cell.gap if cell.framing == "future" else event
        timing = EventTiming(event, stop - PREFIX_STEP, stop, stop + cell.gap)
        if timing.start >= 0 and timing.target <= scene.frames - 1 - TAIL:
            yield timing


def make_item(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> SelectionItem | None:
    """Make an item of a cell around one of the scene's collisions, tried in a random order."""
    cell = CELLS[subtype]
    timings = list(event_timings(scene, cell))
    for k in rng.permutation(len(timings)):
        timing = timings[k]
        prefix = (timing.start, timing.stop)
        picked = picker.pick(
            FrameRef(scene.scene_id, timing.target),
            wrong_frames(cell, scene, timing, rng, picker),
            visible_objects(scene, prefix),
            None if cell.distractors == "cross_scene" else int(rng.integers(4)),
        )
        if picked is not None:
            return new_item(
                scene,
                "event",
                subtype,
                QUESTION,
                prefix,
                timing.target,
                picked,
                event_frame=timing.event,
                framing=cell.framing,
                distractors=cell.distractors,
                gap=cell.gap,
            )
    return None


def wrong_frames(
    cell: EventCell,
    scene: Scene,
    timing: EventTiming,
    rng: np.random.Generator,
    picker: DistractorPicker,
) -> Iterable[Candidate]:
    """Candidate distractors of the cell's source, best first.

    Sources: frames at fixed offsets from the target, the scene's frames most similar to the
    target, or the targets of other scenes.
    """
    target, prefix = timing.target, (timing.start, timing.stop)
    if cell.distractors == "same_offset":
        pool = [f for o in OFFSETS for f in (target - o, target + o) if 0 <= f < scene.frames]
        wrong = rng.permutation(outside_prefix(pool, prefix))
        return scene_candidates(scene, wrong, cell.distractors)
    if cell.distractors == "same_obj_match":
        similar = np.argsort(object_match_scores(scene, target), kind="stable")
        wrong = outside_prefix(similar[similar != target], prefix)
        return scene_candidates(scene, wrong, cell.distractors)
    return (
        Candidate(other.scene_id, first.target, cell.distractors)
        for other in picker.sample_scenes(scene, rng, CROSS_SCENES)
        for first in list(event_timings(other, cell))[:1]
    )
