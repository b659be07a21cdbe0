"""Controls change one property of an item, its question or its prefix, and keep all others."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.items.controls import prefix_under_control
from dynapix.data.records import sample_prefix_frames

SHARED_FIELDS = (
    "scene_id", "prefix_start", "prefix_stop", "target_frame", "event_frame", "candidates",
    "answer", "horizon", "distractors", "split",
)  # fmt: skip


def test_matched_pair_differs_only_in_its_anchor(benchmark_store) -> None:
    items = benchmark_store.selection(suite=MATCHED_ANCHOR)
    assert len(items) >= 4
    for by_event, by_time in zip(items[::2], items[1::2], strict=True):
        assert (by_event.family, by_time.family) == ("event", "time")
        assert by_event.question != by_time.question
        for field in SHARED_FIELDS:
            assert getattr(by_event, field) == getattr(by_time, field)
        events = [c.frame for c in benchmark_store.scene(by_event.scene_id).collisions]
        assert by_event.target_frame == min(e for e in events if e > by_event.prefix_stop)
        assert by_event.prefix_stop - by_event.prefix_start + 1 == 26
        # As in the time family, the target is the first frame after the stated seconds.
        seconds = (by_event.target_frame - by_event.prefix_stop - 1) / 26
        assert seconds in (1, 2)
        assert f"like {seconds:g} second" in by_time.question


@pytest.mark.parametrize("count", [2, 5, 12])
def test_controls_shuffle_or_remove_the_prefix(benchmark_store, count) -> None:
    for item in benchmark_store.selection("test"):
        frames = sample_prefix_frames(item.prefix_start, item.prefix_stop, count)
        shuffled = prefix_under_control(item, count, "shuffled_prefix")
        assert shuffled != frames
        assert sorted(shuffled) == frames
        assert prefix_under_control(item, count, "shuffled_prefix") == shuffled
        assert prefix_under_control(item, count, "candidate_only") == []
        assert prefix_under_control(item, count, None) == frames
    other = replace(item, item_id="another")
    assert count == 2 or prefix_under_control(other, count, "shuffled_prefix") != shuffled
