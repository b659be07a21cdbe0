"""Frames that were decoded are kept, and no more of them than memory is given for."""

from __future__ import annotations

import numpy as np

from data.render import frame_cache
from data.render.frame_cache import FrameReader


def test_what_is_kept_is_bounded_however_frames_were_asked_for(micro_store, monkeypatch) -> None:
    """One frame in twelve is asked for again and again: the other eleven must go all the same."""
    bound = 24 * 192 * 128 * 3
    monkeypatch.setattr(frame_cache, "CACHE_BYTES", bound)
    shown = FrameReader(micro_store)
    scene_ids = [*micro_store.scene_ids("train"), *micro_store.scene_ids("test")]
    for scene_id in scene_ids:
        shown.stack(scene_id, list(range(12)))
        for other in scene_ids:
            shown.array(other, 0)
    kept = shown._kept.values()
    # A view would keep what it is a view of.
    assert all(pixels.base is None for pixels in kept)
    assert sum(pixels.nbytes for pixels in kept) <= bound


def test_what_is_kept_is_what_was_decoded(micro_store) -> None:
    scene_id, shown = micro_store.scene_ids("test")[0], FrameReader(micro_store)
    first = shown.stack(scene_id, [3, 1, 3])
    np.testing.assert_array_equal(first, shown.stack(scene_id, [3, 1, 3]))
    np.testing.assert_array_equal(first[1], FrameReader(micro_store).array(scene_id, 1))
    # Who changes what was given changes nothing that is kept.
    first[:] = 0
    assert shown.array(scene_id, 3).any()
