"""The time family: which frame shows the scene one or two seconds after the observation ends."""

from __future__ import annotations

from typing import Any

import numpy as np

from data.records import SELECTION_SECOND, FrameRef, Scene, SelectionItem
from data.tracks.selection.distractors import (
    DistractorPicker,
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
    """Make an item whose prefix is the scene's first second."""
    stop = SELECTION_SECOND - 1
    target = SELECTION_SECOND + SELECTION_SECOND * CELLS[subtype]
    return make_item_at(scene, (0, stop), target, rng, picker)


def make_item_at(
    scene: Scene,
    prefix: tuple[int, int],
    target: int,
    rng: np.random.Generator,
    picker: DistractorPicker,
    **axes: Any,
) -> SelectionItem | None:
    """Make an item whose question gives the seconds from the prefix's end to `target`.

    The distractors are other frames after the prefix. `axes` are those of `new_item`.
    """
    horizon = target - prefix[1]
    seconds = horizon // SELECTION_SECOND
    later = rng.permutation(np.arange(prefix[1] + 1, scene.frames))
    picked = picker.pick(
        FrameRef(scene.scene_id, target),
        scene_candidates(scene, later[later != target], "same_time"),
        visible_objects(scene, prefix),
        int(rng.integers(4)),
    )
    if picked is None:
        return None
    axes |= {"distractors": "same_time", "horizon": horizon}
    subtype = f"in_{seconds}s"
    return new_item(scene, "time", subtype, question(seconds), prefix, target, picked, **axes)
