"""The recipes of the suite `dynapix`: one for each cell of the three families, and matched pairs.

The suite `tracks` has those that need no contacts; its seconds are as long as the scenes' own.

*event*: the target shows the scene at, or just after, a collision. Framing *future*: the prefix
ends `gap` frames before the next collision, whose frame is the target. Framing *contact*: the
prefix ends at the collision, and the target is `gap` frames later.

*time*: the prefix is the first second, and the target is a quarter of a second to three seconds
after it.

*window*: the target is a few frames (the horizon) after the prefix. The group is that of the
events (`window_group`). The window family selects the objects that the item is about, among those
on screen in the prefix (A: all, B: the pair of the next collision, C: the object that moves most).
Distractors of hard items are the frames most similar to the target; those of easy items are random
frames of the less similar half.

*matched*: the two items of a matched-anchor pair share prefix, target and candidates; the target is
the next collision, one or two seconds after the prefix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice, product
from typing import Any

import numpy as np

from dynapix.conf.schema.benchmark import (
    MATCHED_ANCHOR,
    WINDOW_DIFFICULTIES,
    WINDOW_FAMILIES,
    WINDOW_HORIZONS,
    needs_contacts,
)
from dynapix.data.items.pickers import DistractorPicker, Pool, Recipe, Timing, visible_objects
from dynapix.data.oracle.displacement import object_match_scores, visible_positions
from dynapix.data.oracle.events import collision_frames, is_next, next_collision, window_group
from dynapix.data.records import SELECTION_SECOND, Candidate, Scene, SelectionItem

EVENT_OBSERVED, WINDOW_OBSERVED = 21, 16
"""Numbers of frames of a prefix. The first and last frame of event items differ by 20."""
TAIL = 10
"""Minimum number of frames after the target of an event item."""
OFFSETS = (16, 32, 48)
"""Offsets of same-scene distractors from the target of an event item, in frames on either side."""
CROSS_SCENES = 24
"""Number of other scenes to sample for cross-scene distractors."""

EVENT_QUESTION = "Which image is closest to the correct future state of the whole scene?"
WINDOW_QUESTION = "Which image best matches the next scene state?"
TIME_QUESTION = (
    "Watch the 1-second observation video. Which image best shows what the scene will look like "
    "{} after the observation ends?"
)
MATCHED_QUESTION = (
    "Watch the 1-second observation video. Which image best shows what the scene will look like "
    "at the moment of the next collision?"
)

EVENT_CELLS = {
    "future_cross_gap10": ("future", "cross_scene", 10),
    "future_offset_gap10": ("future", "same_offset", 10),
    "future_match_gap10": ("future", "same_obj_match", 10),
    "future_match_gap5": ("future", "same_obj_match", 5),
    "contact_cross": ("contact", "cross_scene", 10),
    "contact_offset": ("contact", "same_offset", 10),
    "contact_match": ("contact", "same_obj_match", 10),
}
"""Framing, distractors and gap by subtype (paper, Table "The seven event-anchored subtypes")."""
TIME_CELLS = {
    "in_250ms": 0.25, "in_500ms": 0.5, "in_1s": 1, "in_1500ms": 1.5, "in_2s": 2, "in_3s": 3,
}  # fmt: skip
"""Seconds between the prefix and the target, by subtype. A point in a name would divide the key of
a setting."""
MATCHED_SECONDS = (1, 2)
"""Seconds between the prefix and the target of matched-anchor items."""
WINDOW_CELLS = {
    f"{group}_{family}_h{horizon}_{difficulty}": (group, family, horizon, difficulty)
    for group, families in WINDOW_FAMILIES.items()
    for family, horizon, difficulty in product(families, WINDOW_HORIZONS, WINDOW_DIFFICULTIES)
}
"""Group, window family, horizon and difficulty by subtype."""
CELLS = {"event": tuple(EVENT_CELLS), "time": tuple(TIME_CELLS), "window": tuple(WINDOW_CELLS)}
"""The subtypes of each family."""
CELLS_WITHOUT_CONTACTS = {
    "event": (),
    "time": CELLS["time"],
    "window": tuple(name for name in WINDOW_CELLS if not needs_contacts(name)),
}
"""The subtypes of each family of the suite `tracks`, whose scenes do not record contacts."""


def make_recipe(suite: str, family: str, subtype: str) -> Recipe:
    """Return the recipe of a cell of the suite `dynapix` or `tracks`."""
    if family == "event":
        return event_recipe(subtype)
    if family == "time":
        timings = partial(time_timings, TIME_CELLS[subtype], suite)
        return Recipe("time", timings, time_fields, frames_after_prefix, suite=suite)
    return window_recipe(suite, subtype)


def event_recipe(subtype: str) -> Recipe:
    framing, distractors, gap = EVENT_CELLS[subtype]

    def timings(scene: Scene) -> list[Timing]:
        lead = gap if framing == "future" else 0
        every = [
            Timing(stop - EVENT_OBSERVED + 1, stop, stop + gap, event)
            for event in collision_frames(scene)
            if EVENT_OBSERVED <= (stop := event - lead) + 1 <= scene.frames - TAIL - gap
        ]
        return [t for t in every if framing == "contact" or is_next(scene, t.stop, t.event)]

    def pools(scene: Scene, timing: Timing, picker: DistractorPicker) -> Sequence[Pool]:
        if distractors == "cross_scene":
            return [(cross_scene_targets(picker, scene, timings, CROSS_SCENES), 3)]
        if distractors == "same_offset":
            sides = [f for o in OFFSETS for f in (timing.target - o, timing.target + o)]
            frames = picker.rng.permutation([f for f in sides if 0 <= f < scene.frames])
        else:
            frames = similar_frames(scene, timing.target)
        wrong = scene_candidates(scene, timing.outside_prefix(frames), distractors)
        return balance_in_time(wrong, timing.target, picker.rng)

    fields = {
        "subtype": subtype, "question": EVENT_QUESTION, "framing": framing,
        "distractors": distractors, "gap": gap,
    }  # fmt: skip
    return Recipe("event", timings, lambda timing: fields, pools)


def time_timings(seconds: float, suite: str, scene: Scene) -> list[Timing]:
    """Return the single timing of a scene, whose prefix is the first second. The target is the
    first frame after the stated seconds, rounded down to whole frames: a quarter of a second of 26
    frames is 6 frames. In the suite `tracks`, seconds are the scene's own."""
    second = round(scene.fps) if suite == "tracks" else SELECTION_SECOND
    target = second + int(second * seconds)
    return [Timing(0, second - 1, target)] if target < scene.frames else []


def time_fields(timing: Timing) -> dict[str, Any]:
    horizon = timing.target - timing.stop
    # The prefix is a second.
    subtype, seconds = next(
        cell for cell in TIME_CELLS.items() if int(timing.observed * cell[1]) == horizon - 1
    )
    return {
        "subtype": subtype,
        "question": TIME_QUESTION.format(spell_seconds(seconds)),
        "distractors": "same_time",
        "horizon": horizon,
    }


def spell_seconds(count: float) -> str:
    words = {0.25: "a quarter of a second", 0.5: "half a second", 1: "1 second"}
    return words.get(count) or f"{count} seconds"


def frames_after_prefix(scene: Scene, timing: Timing, picker: DistractorPicker) -> Sequence[Pool]:
    """Return pools of the other frames after the prefix."""
    later = picker.rng.permutation(np.arange(timing.stop + 1, scene.frames))
    wrong = scene_candidates(scene, later[later != timing.target], "same_time")
    return balance_in_time(wrong, timing.target, picker.rng)


def window_recipe(suite: str, subtype: str) -> Recipe:
    group, window_family, horizon, difficulty = WINDOW_CELLS[subtype]
    is_hard = difficulty == "hard"
    source = "same_near" if is_hard else "same_far"

    def timings(scene: Scene) -> list[Timing]:
        stops = range(WINDOW_OBSERVED - 1, scene.frames - horizon)
        return [Timing(stop - WINDOW_OBSERVED + 1, stop, stop + horizon) for stop in stops]

    def find_subjects(scene: Scene, timing: Timing) -> tuple[int, ...]:
        if window_group(scene, timing.start, timing.stop, horizon) != group:
            return ()
        visible = visible_objects(scene, timing)
        return tuple(k for k in window_subjects(window_family, scene, timing) if k in visible)

    def pools(scene: Scene, timing: Timing, picker: DistractorPicker) -> Sequence[Pool]:
        subjects = find_subjects(scene, timing)
        frames = timing.outside_prefix(similar_frames(scene, timing.target, subjects))
        if not is_hard:
            # Shuffled, because the least similar frames are consecutive and the target would stand
            # out.
            frames = picker.rng.permutation(frames[len(frames) // 2 :])
        return balance_in_time(scene_candidates(scene, frames, source), timing.target, picker.rng)

    fields = {
        "subtype": subtype, "question": WINDOW_QUESTION, "distractors": source, "group": group,
        "window_family": window_family, "horizon": horizon, "difficulty": difficulty,
    }  # fmt: skip
    return Recipe("window", timings, lambda timing: fields, pools, find_subjects, suite)


def window_subjects(window_family: str, scene: Scene, timing: Timing) -> tuple[int, ...]:
    """Return the objects that a window family selects: none if no collision occurs up to the target
    (B), or nothing visible moves (C)."""
    stop, target = timing.stop, timing.target
    if window_family == "A":
        return tuple(range(len(scene.objects)))
    if window_family == "B":
        collision = next_collision(scene, stop)
        return collision.objects if collision and collision.frame <= target else ()
    positions, visible = visible_positions(scene)
    moved = np.linalg.norm(positions[target] - positions[stop], axis=-1)
    moved[~(visible[target] & visible[stop])] = 0
    return (int(moved.argmax()),) if moved.max(initial=0) > 0 else ()


def matched_timings(scene: Scene) -> list[Timing]:
    """Return timings with a 1-second prefix and the next collision as target, one or two seconds
    later as the time family counts them."""
    every = [
        Timing(stop - SELECTION_SECOND + 1, stop, target, event=target)
        for target in collision_frames(scene)
        for seconds in MATCHED_SECONDS
        if (stop := target - seconds * SELECTION_SECOND - 1) >= SELECTION_SECOND - 1
        and target <= scene.frames - 1 - TAIL
    ]
    return [t for t in every if is_next(scene, t.stop, t.event)]


MATCHED = Recipe("time", matched_timings, time_fields, frames_after_prefix)
"""The recipe of the time items of matched-anchor pairs."""


def make_pair(item: SelectionItem) -> tuple[SelectionItem, SelectionItem]:
    """Return the event item and the time item of the pair that a time item belongs to."""
    key = pair_key(item)
    by_time = replace(item, suite=MATCHED_ANCHOR, item_id=f"{MATCHED_ANCHOR}-time-{key}")
    by_event = replace(
        by_time,
        item_id=f"{MATCHED_ANCHOR}-event-{key}",
        family="event",
        subtype="next_collision",
        question=MATCHED_QUESTION,
    )
    return by_event, by_time


def pair_key(item: SelectionItem) -> str:
    return f"{item.scene_id}-{item.prefix_stop}-{item.target_frame}"


def similar_frames(
    scene: Scene, target: int, subjects: tuple[int, ...] | None = None
) -> np.ndarray:
    """Return the frames of a scene except the target, those most similar to it first."""
    similar = np.argsort(object_match_scores(scene, target, subjects), kind="stable")
    return similar[similar != target]


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Yield frames of a scene as candidates with this `source`."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)


def cross_scene_targets(
    picker: DistractorPicker, scene: Scene, timings: Callable[[Scene], Sequence[Timing]], count: int
) -> list[Candidate]:
    """Return the first target of up to `count` other scenes of the split and of the scene's
    scenario. Scenes that share more objects with `scene` come first."""
    inputs, scene_ids = picker.inputs, picker.inputs.scene_ids[picker.split]
    order = picker.rng.permutation(len(scene_ids))
    # The generators are lazy: no more scenes are loaded than needed.
    scenes = (inputs.scene_of(scene_ids[k]) for k in order)
    others = (s for s in scenes if s.scene_id != scene.scene_id and s.scenario == scene.scenario)
    found = islice(((s, own) for s in others if (own := timings(s))), count)
    objects = {*scene.objects}
    ranked = sorted(found, key=lambda pair: -len(objects & {*pair[0].objects}))
    return [Candidate(s.scene_id, own[0].target, "cross_scene") for s, own in ranked]


def balance_in_time(
    pool: Iterable[Candidate], target: int, rng: np.random.Generator
) -> tuple[Pool, Pool, Pool]:
    """Divide a pool so that a random number (0 to 3) of the distractors precedes the target.

    The pools are frames before the target, frames after it, and all frames in case these are too
    few. Without this, the candidates' order in time would often reveal the target.
    """
    pool = list(pool)
    earlier = int(rng.integers(4))
    before = [c for c in pool if c.frame < target]
    after = [c for c in pool if c.frame > target]
    return (before, earlier), (after, 3 - earlier), (pool, 3)
