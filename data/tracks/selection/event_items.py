"""The event family: items whose target shows the scene at, or just after, a collision.

Framing *future*: the prefix ends `gap` frames before the collision, and the target is the frame of
the collision. Framing *contact*: the prefix ends at the collision, and the target is `gap` frames
later.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from data.records import Candidate, Scene, SelectionItem
from data.tracks.selection.balanced_items import Picker
from data.tracks.selection.distractors import (
    Family,
    Pool,
    Timing,
    balance_in_time,
    scene_candidates,
    visible_objects,
)
from data.world.displacement import object_match_scores
from data.world.events import collision_frames

QUESTION = "Which image is closest to the correct future state of the whole scene?"
OBSERVED = 21
"""Default number of frames of a prefix: its first and last frame differ by 20."""
TAIL = 10
"""Minimum number of frames after the target."""
OFFSETS = (16, 32, 48)
"""Offsets of same-scene distractors from the target, in frames on either side."""
CROSS_SCENES = 24
"""Number of other scenes to sample for cross-scene distractors."""


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
"""Cells by subtype (paper, Table "The seven event-anchored subtypes")."""


def timings(subtype: str, scene: Scene, observed: int = OBSERVED) -> list[Timing]:
    """Return a timing for each collision that leaves room for a prefix of `observed` frames, the
    target and `TAIL`."""
    cell = CELLS[subtype]
    lead = cell.gap if cell.framing == "future" else 0
    return [
        Timing(stop - observed + 1, stop, stop + cell.gap, event)
        for event in collision_frames(scene)
        if (stop := event - lead) >= observed - 1 and stop + cell.gap <= scene.frames - 1 - TAIL
    ]


def make_item(
    subtype: str, scene: Scene, timing: Timing, rng: np.random.Generator, picker: Picker
) -> SelectionItem | None:
    """Make an item of a cell around a collision."""
    cell = CELLS[subtype]

    def make_pools() -> Sequence[Pool]:
        if cell.distractors == "cross_scene":
            scenes = picker.sample_scenes(scene, rng, CROSS_SCENES)
            found = ((other, timings(subtype, other, timing.observed)) for other in scenes)
            targets = (Candidate(o.scene_id, t[0].target, "cross_scene") for o, t in found if t)
            return [(targets, 3)]
        frames = _wrong_frames(cell, scene, timing, rng)
        wrong = scene_candidates(scene, frames, cell.distractors)
        return balance_in_time(wrong, timing.target, rng)

    return picker.make_item(
        scene,
        timing,
        make_pools,
        visible_objects(scene, timing),
        family="event",
        subtype=subtype,
        question=QUESTION,
        **asdict(cell),
    )


def _wrong_frames(
    cell: EventCell, scene: Scene, timing: Timing, rng: np.random.Generator
) -> Iterable[int]:
    """Return frames outside the prefix that are not the target: for same_offset, those at `OFFSETS`
    from the target in random order; otherwise all, with the most similar to the target first."""
    target = timing.target
    if cell.distractors == "same_offset":
        pool = [f for o in OFFSETS for f in (target - o, target + o) if 0 <= f < scene.frames]
        return rng.permutation(timing.outside_prefix(pool))
    similar = np.argsort(object_match_scores(scene, target), kind="stable")
    return timing.outside_prefix(similar[similar != target])


FAMILY = Family(CELLS, timings, make_item)
