"""The time family: items whose target shows the scene one or two seconds after the prefix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.records import SELECTION_SECOND, Scene, SelectionItem
from data.tracks.selection.balanced_items import Picker
from data.tracks.selection.distractors import (
    Family,
    Pool,
    Timing,
    balance_in_time,
    scene_candidates,
    visible_objects,
)

CELLS = {"in_1s": 1, "in_2s": 2}
"""Seconds between the prefix and the target, by subtype."""


def spell_seconds(count: int) -> str:
    return "1 second" if count == 1 else f"{count} seconds"


def question(seconds: int) -> str:
    return (
        "Watch the 1-second observation video. Which image best shows what the scene will look "
        f"like {spell_seconds(seconds)} after the observation ends?"
    )


def timings(subtype: str, scene: Scene) -> list[Timing]:
    """Return the single timing of a scene, whose prefix is the first second."""
    return [Timing(0, SELECTION_SECOND - 1, SELECTION_SECOND * (1 + CELLS[subtype]))]


def make_item(
    subtype: str, scene: Scene, timing: Timing, rng: np.random.Generator, picker: Picker
) -> SelectionItem | None:
    """Make an item whose distractors are other frames after the prefix.

    The item's question and subtype state the whole seconds from the prefix to the target of the
    timing; `subtype` is ignored, because matched-anchor pairs call this function with another one.
    """
    horizon = timing.target - timing.stop
    seconds = horizon // SELECTION_SECOND

    def make_pools() -> Sequence[Pool]:
        later = rng.permutation(np.arange(timing.stop + 1, scene.frames))
        wrong = scene_candidates(scene, later[later != timing.target], "same_time")
        return balance_in_time(wrong, timing.target, rng)

    return picker.make_item(
        scene,
        timing,
        make_pools,
        visible_objects(scene, timing),
        family="time",
        subtype=f"in_{seconds}s",
        question=question(seconds),
        distractors="same_time",
        horizon=horizon,
    )


FAMILY = Family(CELLS, timings, make_item)
