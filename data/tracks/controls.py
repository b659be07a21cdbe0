"""Controls that separate what a student is asked from how its items are built.

Matched-anchor pairs are two items alike in prefix, target, horizon and candidates, of which one
names the event that happens at the target and the other the time that passes until then. The other
controls show an item of any suite otherwise than it is: without its prefix, or with the prefix's
frames out of order.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from conf.schema import Quota
from data.records import SELECTION_SECOND, FrameRef, Scene, SelectionItem, sample_prefix_frames
from data.tracks.selection import distractors, event, time
from data.tracks.selection.distractors import DistractorPicker, Draft, scene_candidates
from data.world.events import collisions_in

MATCHED_ANCHOR = "matched_anchor"
"""The suite of the pairs' items."""
EVENT_QUESTION = (
    "Watch the 1-second observation video. Which image best shows what the scene will look like "
    "at the moment of the next collision?"
)
SECONDS = (1, 2)


@dataclass(frozen=True)
class AnchorTiming:
    """An observation's inclusive range and the collision that comes `seconds` after it."""

    start: int
    stop: int
    target: int
    seconds: int


def anchor_timings(scene: Scene) -> Iterator[AnchorTiming]:
    """The moments at which the next collision comes whole seconds after a second of observation."""
    for target in dict.fromkeys(c.frame for c in scene.collisions):
        for seconds in SECONDS:
            stop = target - seconds * SELECTION_SECOND
            start = stop - SELECTION_SECOND + 1
            alone = not collisions_in(scene, stop + 1, target - 1)
            if start >= 0 and alone and target <= scene.frames - 1 - event.TAIL:
                yield AnchorTiming(start, stop, target, seconds)


def draft(scene: Scene, rng: np.random.Generator, picker: DistractorPicker) -> Draft | None:
    """The item of a pair that names the time, at a random moment of the scene; its distractors are
    other moments after the observation."""
    found = list(anchor_timings(scene))
    for k in rng.permutation(len(found)):
        moment = found[k]
        later = rng.permutation(np.arange(moment.stop + 1, scene.frames))
        pool = scene_candidates(scene, later[later != moment.target], "same_time")
        prefix = (moment.start, moment.stop)
        target = FrameRef(scene.scene_id, moment.target)
        picked = picker.pick(
            target, pool, distractors.visible_objects(scene, prefix), int(rng.integers(4))
        )
        if picked is not None:
            return Draft(
                scene,
                "time",
                f"in_{moment.seconds}s",
                time.question(moment.seconds),
                prefix,
                moment.target,
                *picked,
                {
                    "event_frame": moment.target,
                    "distractors": "same_time",
                    "horizon": moment.target - moment.stop,
                },
            )
    return None


def fill_pairs(
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    seed: int,
    least: float,
) -> tuple[list[SelectionItem], int]:
    """Pairs up to the quota, each as two items one after the other; see `drafts.fill`."""
    items, dropped = distractors.fill(
        MATCHED_ANCHOR, draft, scene_ids, scene_of, quota, seed, least
    )
    return [each for item in items for each in _pair(item)], dropped


def _pair(item: SelectionItem) -> tuple[SelectionItem, SelectionItem]:
    place = _place(item)
    by_time = replace(item, suite=MATCHED_ANCHOR, item_id=f"{MATCHED_ANCHOR}-time-{place}")
    by_event = replace(
        by_time,
        item_id=f"{MATCHED_ANCHOR}-event-{place}",
        family="event",
        subtype="next_collision",
        question=EVENT_QUESTION,
    )
    return by_event, by_time


def pair_items(items: Sequence[SelectionItem]) -> list[tuple[SelectionItem, SelectionItem]]:
    """The matched-anchor pairs among items, in their order: that which names the event, and that
    which names the time."""
    by_time = {_place(item): item for item in items if item.family == "time"}
    return [(item, by_time[_place(item)]) for item in items if item.family == "event"]


def _place(item: SelectionItem) -> str:
    return f"{item.scene_id}-{item.prefix_stop}-{item.target_frame}"


def prefix_under_control(item: SelectionItem, count: int, control: str | None) -> list[int]:
    """The frames that are shown as an item's prefix, in the order in which they are shown: `count`
    of them, in another order for `shuffled_prefix`, none for `candidate_only`."""
    if control == "candidate_only":
        return []
    shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, count)
    if control == "shuffled_prefix":
        digest = hashlib.sha256(item.item_id.encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        order = np.arange(len(shown))
        while (order == np.arange(len(shown))).all():
            order = rng.permutation(len(shown))
        return [shown[k] for k in order]
    return shown
