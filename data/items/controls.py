"""Controls of the selection track: matched-anchor pairs, no prefix, and shuffled prefixes.

The two items of a matched-anchor pair share prefix, target, horizon and candidates. The question of
one item names the event at the target, and that of the other the time from prefix to target. The
other two controls remove the prefix of an existing item, or shuffle the frames of its prefix.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from dynapix.conf.schema.benchmark import INTERVENTIONS
from dynapix.data.items.recipes import pair_key
from dynapix.data.records import INTERVENTION, SelectionItem, sample_prefix_frames


def pair_items(items: Sequence[SelectionItem]) -> list[tuple[SelectionItem, SelectionItem]]:
    """Return the complete pairs among `items` of a paired suite, in order: matched-anchor pairs as
    (event item, time item), and pairs about interventions as (actual future, changed future)."""
    second = {_full_key(item): item for item in items if _is_second(item)}
    first = [item for item in items if not _is_second(item)]
    return [(item, second[_full_key(item)]) for item in first if _full_key(item) in second]


def _full_key(item: SelectionItem) -> tuple[str, ...]:
    """Return what the items of a pair share. A collision can have several interventions."""
    is_about_change = item.suite == INTERVENTIONS
    return pair_key(item), item.subtype if is_about_change else ""


def _is_second(item: SelectionItem) -> bool:
    return item.family == "time" or item.framing == INTERVENTION


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
