"""Images and videos whose brightness encodes the frame index."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path

import av
from PIL import Image

SIZE = 48, 32


def picture(frame: int, size: tuple[int, int] = SIZE) -> Image.Image:
    """Return an image whose brightness encodes the frame index, modulo 150."""
    return Image.new("RGB", size, (frame % 150 + 60,) * 3)


def png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()


def write_video(path: Path, frames: int, size: tuple[int, int] = SIZE, fps: int = 25) -> None:
    """Write a video of pictures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for f in range(frames):
            frame = av.VideoFrame.from_image(picture(f, size))
            frame.pts, frame.time_base = f, Fraction(1, fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
