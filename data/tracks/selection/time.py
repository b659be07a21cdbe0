"""The time family: which frame shows the scene one or two seconds after the observation ends."""

from __future__ import annotations

import numpy as np

from data.records import SELECTION_SECOND, FrameRef, Scene, SelectionItem
from data.tracks.selection.distractors import (
    DistractorPicker,
    Picked,
    new_item,
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


def make_item(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> SelectionItem | None:
    """Make an item whose prefix is the scene's first second; distractors are later frames."""
    seconds = CELLS[subtype]
    prefix = start, stop = 0, SELECTION_SECOND - 1
    target = start + SELECTION_SECOND + SELECTION_SECOND * seconds
    picked = pick_later_frames(scene, prefix, target, rng, picker)
    if picked is None:
        return None
    return new_item(
        scene,
        "time",
        subtype,
        question(seconds),
        prefix,
        target,
        picked,
        distractors="same_time",
        horizon=target - stop,
    )


def pick_later_frames(
    scene: Scene,
    prefix: tuple[int, int],
    target: int,
    rng: np.random.Generator,
    picker: DistractorPicker,
) -> Picked | None:
    """Pick distractors among the scene's frames after the prefix, in a random order."""
    later = rng.permutation(np.arange(prefix[1] + 1, scene.frames))
    pool = scene_candidates(scene, later[later != target], "same_time")
    about = visible_objects(scene, prefix)
    return picker.pick(FrameRef(scene.scene_id, target), pool, about, int(rng.integers(4)))
