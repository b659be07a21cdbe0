"""The time family: which frame shows the scene one or two seconds after the observation ends."""

from __future__ import annotations

import numpy as np

from data.records import SELECTION_SECOND, FrameRef, Scene
from data.tracks.selection.distractors import (
    DistractorPicker,
    Draft,
    scene_candidates,
    visible_objects,
)

CELLS = {"in_1s": 1, "in_2s": 2}
"""Seconds from the observation's end to the target, by subtype."""


def question(seconds: int) -> str:
    spelled = "1 second" if seconds == 1 else f"{seconds} seconds"
    return (
        "Watch the 1-second observation video. Which image best shows what the scene will look "
        f"like {spelled} after the observation ends?"
    )


def draft(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> Draft | None:
    """An item whose prefix is the scene's first second; distractors are later moments of the same
    scene."""
    seconds = CELLS[subtype]
    start, stop = 0, SELECTION_SECOND - 1
    target = start + SELECTION_SECOND + SELECTION_SECOND * seconds
    later = rng.permutation(np.arange(stop + 1, scene.frames))
    pool = scene_candidates(scene, later[later != target], "same_time")
    about = visible_objects(scene, (start, stop))
    picked = picker.pick(FrameRef(scene.scene_id, target), pool, about, int(rng.integers(4)))
    if picked is None:
        return None
    return Draft(
        scene,
        "time",
        subtype,
        question(seconds),
        (start, stop),
        target,
        *picked,
        {"distractors": "same_time", "horizon": target - stop},
    )
