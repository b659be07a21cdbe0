"""The media of items have the pixels of the frames, and no metadata."""

from __future__ import annotations

import io

import av
import numpy as np
import pytest
from PIL import Image

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation.study.media import IMAGE, PREFIX, VIDEO, encode_media, encode_video

END = b"\x00\x00\x00\x00IEND\xaeB`\x82"


@pytest.fixture(scope="module")
def item(micro_store):
    return next(i for i in micro_store.selection("test") if i.family == "time")


def test_candidates_are_lossless_images_of_equal_file_size(micro_store, item) -> None:
    frames = FrameReader(micro_store)
    prefix, *candidates = encode_media(item, frames)
    assert (prefix.slot, prefix.kind) == (PREFIX, VIDEO)
    assert [m.slot for m in candidates] == [0, 1, 2, 3]
    assert {m.kind for m in candidates} == {IMAGE}
    assert len({len(m.content) for m in candidates}) == 1
    for medium, candidate in zip(candidates, item.candidates, strict=True):
        with Image.open(io.BytesIO(medium.content)) as image:
            pixels = frames.array(candidate.scene_id, candidate.frame)
            assert np.array_equal(np.asarray(image), pixels)
            assert not image.info
            assert image.size == (medium.width, medium.height)
        head, end, rest = medium.content.partition(END)
        assert end
        assert not rest.strip(b"\0")
        assert all(chunk not in head for chunk in (b"tEXt", b"tIME", b"eXIf", b"iTXt", b"zTXt"))


def test_a_prefix_is_a_video_of_every_frame_without_metadata(micro_store, item) -> None:
    frames = FrameReader(micro_store)
    prefix = encode_media(item, frames)[0]
    prefix_frames = list(range(item.prefix_start, item.prefix_stop + 1))
    with av.open(io.BytesIO(prefix.content)) as video:
        stream = video.streams.video[0]
        assert float(stream.average_rate) == frames.scene(item.scene_id).fps
        decoded = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        metadata = {**video.metadata, **stream.metadata}
    assert len(decoded) == len(prefix_frames)
    expected = frames.stack(item.scene_id, prefix_frames).astype(int)
    assert np.abs(np.stack(decoded) - expected).mean() < 3
    assert set(metadata) <= {"major_brand", "minor_version", "compatible_brands", "language",
                         "handler_name"}  # fmt: skip
    assert item.scene_id.encode() not in prefix.content


def test_videos_of_odd_size_are_padded_to_even_size() -> None:
    pixels = np.random.default_rng(0).integers(256, size=(4, 51, 75, 3)).astype(np.uint8)
    with av.open(io.BytesIO(encode_video(pixels, 30.0))) as video:
        assert (video.streams.video[0].width, video.streams.video[0].height) == (76, 52)
        assert len(list(video.decode(video=0))) == 4
