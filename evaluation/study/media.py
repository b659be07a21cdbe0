"""Encode the frames of items as images and videos without metadata."""

from __future__ import annotations

import io
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from PIL import Image

from dynapix.conf.errors import UserError
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SelectionItem

VIDEO, IMAGE = "video/mp4", "image/png"
PREFIX = -1
"""Slot of an item's prefix; the candidates have slots 0 to 3, in the item's order."""
CRF = "12"
"""Constant rate factor (quality) of x264: the loss is not visible."""


@dataclass(frozen=True)
class Medium:
    slot: int
    kind: str
    width: int
    height: int
    content: bytes


def encode_media(item: SelectionItem, frames: FrameReader) -> list[Medium]:
    """Encode an item's prefix as a video with all of its frames at the scene's frame rate, and its
    candidates as images of equal file size.

    Raises:
        UserError: The frames differ in size, or cannot be read.
    """
    prefix = frames.stack(item.scene_id, list(range(item.prefix_start, item.prefix_stop + 1)))
    candidates = [frames.array(c.scene_id, c.frame) for c in item.candidates]
    sizes = {pixels.shape[:2] for pixels in (prefix[0], *candidates)}
    if len(sizes) > 1:
        raise UserError(
            f"item {item.item_id} has frames of different sizes, which would distinguish its "
            "candidates: give items=FILE with a list of items that leaves it out",
            code="frame-size",
        )
    [(height, width)] = sizes
    images = []
    for pixels in candidates:
        Image.fromarray(pixels).save(target := io.BytesIO(), "PNG")
        images.append(target.getvalue())
    # File sizes must not distinguish candidates. Decoders ignore bytes after the end of a PNG.
    size = max(map(len, images))
    video = encode_video(prefix, frames.scene(item.scene_id).fps)
    return [
        Medium(PREFIX, VIDEO, width, height, video),
        *(Medium(k, IMAGE, width, height, png.ljust(size, b"\0")) for k, png in enumerate(images)),
    ]


def encode_video(pixels: np.ndarray, fps: float) -> bytes:
    """Encode (frames, height, width, 3) uint8 as an mp4 (H.264) without dates.

    The codec needs an even height and width: the last row or column of an odd size is repeated.
    """
    import av

    _, height, width, _ = pixels.shape
    even = np.pad(pixels, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    target = io.BytesIO()
    with av.open(target, "w", format="mp4", options={"fflags": "+bitexact"}) as container:
        rate = Fraction(fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": CRF})
        stream.height, stream.width = even.shape[1:3]
        stream.pix_fmt = "yuv420p"
        images = (av.VideoFrame.from_ndarray(frame, format="rgb24") for frame in even)
        for image in (*images, None):
            container.mux(stream.encode(image))
    return target.getvalue()
