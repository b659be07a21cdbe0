"""The event family: which frame shows the scene at, or just after, a collision.

Framing *future*: the prefix ends `gap` frames before the collision and the target is the event
frame. Framing *contact*: the prefix ends at the collision and the target is `gap` frames later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data.records import Scene
from data.selection.drafts import Draft, Picker, same_scene

QUESTION = "Which image is closest to the correct future state of the whole scene?"
PREFIX_STEP = 20
"""Frames from the prefix's start to its end."""
TAIL = 10
"""Least number of frames between the target and the clip's end."""
OFFSETS = (16, 32, 48)
"""Frames on either side of the target at which same-scene distractors lie."""


@dataclass(frozen=True)
class EventCell:
    framing: str
    distractors: str
    gap: int


CELLS = {
    "future_offset_gap10": EventCell("future", "same_offset", 10),
    "contact_offset": EventCell("contact", "same_offset", 10),
}


def draft(subtype: str, scene: Scene, rng: np.random.Generator, picker: Picker) -> Draft | None:
    """An item of the cell around one of the scene's collisions, tried in a random order."""
    cell = CELLS[subtype]
    for k in rng.permutation(len(scene.collisions)):
        event = scene.collisions[k].frame
        if cell.framing == "future":
            stop, target = event - cell.gap, event
        else:
            stop, target = event, event + cell.gap
        start = stop - PREFIX_STEP
        if start < 0 or target > scene.frames - 1 - TAIL:
            continue
        pool = [f for o in OFFSETS for f in (target - o, target + o) if 0 <= f < scene.frames]
        picked = picker.pick(scene, target, rng.permutation(pool))
        if picked is None:
            continue
        frames, apart = picked
        return Draft(
            scene,
            "event",
            subtype,
            QUESTION,
            (start, stop),
            target,
            same_scene(scene, frames, cell.distractors),
            apart,
            {
                "event_frame": event,
                "framing": cell.framing,
                "distractors": cell.distractors,
                "gap": cell.gap,
            },
        )
    return None
