"""Controls of the selection track: matched-anchor pairs, no prefix, and shuffled prefixes.

The two items of a matched-anchor pair share prefix, target, horizon and candidates. The question of
one item names the event at the target, and that of the other the time from prefix to target. The
other two controls remove the prefix of an existing item, or shuffle the frames of its prefix.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data.records import SELECTION_SECOND, Scene, SelectionItem, sample_prefix_frames
from data.tracks.quota import CellInputs, fill_quota
from data.tracks.selection import event_items, time_items
from data.tracks.selection.distractors import Family, Timing
from data.world.events import collision_frames, collisions_in

MATCHED_ANCHOR = "matched_anchor"
"""Name of the suite of the matched-anchor items."""
EVENT_QUESTION = (
    "Watch the 1-second observation video. Which image best shows what the scene will look like "
    "at the moment of the next collision?"
)
SECONDS = (1, 2)


def timings(subtype: str, scene: Scene) -> list[Timing]:
    """Return timings with a 1-second prefix and the next collision as target, `SECONDS` later."""
    return [
        Timing(stop - SELECTION_SECOND + 1, stop, target, event=target)
        for target in collision_frames(scene)
        for seconds in SECONDS
        if (stop := target - seconds * SELECTION_SECOND) >= SELECTION_SECOND - 1
        and not collisions_in(scene, stop + 1, target - 1)
        and target <= scene.frames - 1 - event_items.TAIL
    ]


def fill_pairs(cell: CellInputs) -> tuple[list[SelectionItem], int]:
    """Make matched-anchor pairs up to the quota: a list with the items of each pair in sequence,
    and the number of targets that `fill_quota` dropped."""
    items, dropped = fill_quota(MATCHED_ANCHOR, Family({}, timings, time_items.make_item), cell)
    return [paired for item in items for paired in _pair(item)], dropped


def _pair(item: SelectionItem) -> tuple[SelectionItem, SelectionItem]:
    key = _pair_key(item)
    by_time = replace(item, suite=MATCHED_ANCHOR, item_id=f"{MATCHED_ANCHOR}-time-{key}")
    by_event = replace(
        by_time,
        item_id=f"{MATCHED_ANCHOR}-event-{key}",
        family="event",
        subtype="next_collision",
        question=EVENT_QUESTION,
    )
    return by_event, by_time


def pair_items(items: Sequence[SelectionItem]) -> list[tuple[SelectionItem, SelectionItem]]:
    """Return the matched-anchor pairs among `items` as (event item, time item), in order."""
    by_time = {_pair_key(item): item for item in items if item.family == "time"}
    return [(item, by_time[_pair_key(item)]) for item in items if item.family == "event"]


def _pair_key(item: SelectionItem) -> str:
    return f"{item.scene_id}-{item.prefix_stop}-{item.target_frame}"


def prefix_under_control(item: SelectionItem, count: int, control: str | None) -> list[int]:
    """Sample `count` frames of an item's prefix, in the order in which a model receives them.

    Args:
        control: `candidate_only` for no frames, `shuffled_prefix` for a random order that differs
            from the order in time, None for the order in time.
    """
    if control == "candidate_only":
        return []
    frames = sample_prefix_frames(item.prefix_start, item.prefix_stop, count)
    if control is None:
        return frames
    digest = hashlib.sha256(item.item_id.encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    shuffled = frames
    while shuffled == frames:
        shuffled = [frames[k] for k in rng.permutation(len(frames))]
    return shuffled
