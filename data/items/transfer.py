"""The recipes of the transfer suites, which test students on scenes of MoVi-A and Physion.

A suite is a set of items that are made in the same way. The transfer suites have the questions of
the suite `dynapix`. Items from CLEVRER's scenes belong to the suite `dynapix`.

Spans and gaps are the paper's numbers of frames at every frame rate. A scene of MoVi-A lasts two
seconds, so there is no in_2s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dynapix.data.items.pickers import DistractorPicker, Pool, Recipe, Timing
from dynapix.data.items.recipes import (
    EVENT_QUESTION,
    TIME_CELLS,
    TIME_QUESTION,
    cross_scene_targets,
    scene_candidates,
    spell_seconds,
)
from dynapix.data.oracle.events import (
    collision_frames,
    find_motion_onsets,
    first_collisions,
    is_next,
)
from dynapix.data.records import Scene

SPAN, GAP = 20, 10
"""Number of frames from the first to the last frame of the prefix of an event item, and from there
to the event, which is the target."""
MIN_PREFIX_FRAMES = 5
"""Minimum number of frames in a prefix, for prefixes that are cut at the start of the scene."""
CROSS_SCENES = 8
"""Number of other scenes to sample for cross-scene distractors."""

EVENTS: dict[str, dict[str, Callable[[Scene], list[int]]]] = {
    "movi_a": {
        "contact": lambda scene: [e for e in collision_frames(scene) if is_next(scene, e - GAP, e)]
    },
    "physion": {
        "A1_contact": lambda scene: [c.frame for c in first_collisions(scene)[:1]],
        "A2_motion": lambda scene: [frame for frame, _ in find_motion_onsets(scene)],
        "A3_landing": lambda scene: [landing.frame for landing in scene.landings],
    },
}
"""Functions that return the frames of a scene's events, by suite and subtype. A contact of MoVi-A
is the next collision after the prefix, and A1 is the first contact of a trial."""
CELLS = {
    "movi_a": {"event": tuple(EVENTS["movi_a"]), "time": ("in_1s",), "window": ()},
    "physion": {"event": tuple(EVENTS["physion"]), "time": ("in_1s", "in_2s"), "window": ()},
}
"""The subtypes of each family, by suite."""


def make_transfer_recipe(recipe: str, suite: str, family: str, subtype: str) -> Recipe:
    """Return the recipe of a cell.

    Args:
        recipe: `movi_a` or `physion`. In MoVi-A, one distractor comes from the item's own scene,
            from after the prefix; in Physion two, from after the target. The others are targets
            from other scenes of the same scenario.
        suite: Name of the suite of the items, that of the recipe or of a stand-in.
    """
    is_event = family == "event"

    def timings(scene: Scene) -> list[Timing]:
        if is_event:
            frames = sorted({*EVENTS[recipe][subtype](scene)})
            stops = [frame - GAP for frame in frames if frame - GAP + 1 >= MIN_PREFIX_FRAMES]
            return [Timing(max(s - SPAN, 0), s, s + GAP, event=s + GAP) for s in stops]
        # The prefix is the first second. As in the suite `dynapix`, the target is the first frame
        # after the stated seconds; a scene of MoVi-A ends one frame earlier.
        second = round(scene.fps)
        end = second * (1 + TIME_CELLS[subtype])
        is_long_enough = scene.frames >= end
        return [Timing(0, second - 1, min(end, scene.frames - 1))] if is_long_enough else []

    def fields(timing: Timing) -> dict[str, Any]:
        lead = timing.target - timing.stop
        axes = {"framing": "future", "gap": lead} if is_event else {"horizon": lead}
        question = EVENT_QUESTION
        if not is_event:
            question = TIME_QUESTION.format(spell_seconds(TIME_CELLS[subtype]))
        fixed = {"suite": suite, "subtype": subtype, "distractors": "mixed"}
        return {**fixed, "question": question, **axes}

    def pools(scene: Scene, timing: Timing, picker: DistractorPicker) -> Sequence[Pool]:
        own, first = (1, timing.stop) if recipe == "movi_a" else (2, timing.target)
        frames = picker.rng.permutation(np.arange(first + 1, scene.frames))
        wrong = scene_candidates(scene, frames[frames != timing.target], "same_time")
        others = cross_scene_targets(picker, scene, timings, CROSS_SCENES)
        return [(wrong, own), (others, 3 - own)]

    return Recipe(family, timings, fields, pools, lambda scene, _: (*range(len(scene.objects)),))
