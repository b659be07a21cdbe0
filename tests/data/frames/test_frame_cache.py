"""The frame cache: archives are exact, and decoded frames take a bounded amount of memory."""

from __future__ import annotations

import numpy as np
import pytest

from dynapix.data.frames import frame_cache
from dynapix.data.frames.frame_cache import FrameReader, load_frames, render_frames, save_frames


def test_decoded_frames_are_bounded_for_any_access_pattern(micro_store, monkeypatch) -> None:
    """Frame 0 of each scene is read repeatedly; the other eleven are read once and evicted."""
    bound = 24 * 192 * 128 * 3
    monkeypatch.setattr(frame_cache, "CACHE_BYTES", bound)
    reader = FrameReader(micro_store)
    scene_ids = [*micro_store.scene_ids("train"), *micro_store.scene_ids("test")]
    for scene_id in scene_ids:
        reader.stack(scene_id, list(range(12)))
        for other in scene_ids:
            reader.array(other, 0)
    decoded = reader._decoded.values()
    # A view of a larger array would keep that array in memory.
    assert all(pixels.base is None for pixels in decoded)
    assert sum(pixels.nbytes for pixels in decoded) <= bound


def test_decoded_frames_are_exact_and_not_shared(micro_store) -> None:
    scene_id, reader = micro_store.scene_ids("test")[0], FrameReader(micro_store)
    first = reader.stack(scene_id, [3, 1, 3])
    np.testing.assert_array_equal(first, reader.stack(scene_id, [3, 1, 3]))
    np.testing.assert_array_equal(first[1], FrameReader(micro_store).array(scene_id, 1))
    first[:] = 0
    assert reader.array(scene_id, 3).any()


def test_stored_frame_equals_a_new_rendering(benchmark_store) -> None:
    item = benchmark_store.selection("train")[0]
    scene, config = benchmark_store.scene(item.scene_id), benchmark_store.manifest["config"]
    rendered = render_frames(scene, [item.target_frame], config)
    stored = FrameReader(benchmark_store).array(item.scene_id, item.target_frame)
    np.testing.assert_array_equal(rendered[item.target_frame], stored)


def test_archive_round_trip_is_exact(tmp_path) -> None:
    rng = np.random.default_rng(0)
    frames = {k: rng.integers(0, 256, (6, 9, 3), dtype=np.uint8) for k in (7, 3, 120)}
    save_frames(frames, tmp_path / "a.zip")
    loaded = load_frames(tmp_path / "a.zip")
    assert list(loaded) == [3, 7, 120]
    for frame, pixels in frames.items():
        np.testing.assert_array_equal(loaded[frame], pixels)
        np.testing.assert_array_equal(load_frames(tmp_path / "a.zip", [frame])[frame], pixels)
    assert load_frames(tmp_path / "a.zip", [4]) == {}
    assert load_frames(tmp_path / "missing.zip") == {}


@pytest.mark.parametrize(
    "damage", [lambda data: data[:40], lambda data: data[:60] + b"x" + data[61:]]
)
def test_damaged_archive_is_logged_and_ignored(tmp_path, caplog, damage) -> None:
    path = tmp_path / "a.zip"
    save_frames({5: np.full((8, 8, 3), 9, np.uint8)}, path)
    path.write_bytes(damage(path.read_bytes()))
    assert load_frames(path) == {}
    assert "a.zip is damaged" in caplog.text
