"""Images whose brightness encodes the frame index."""

from __future__ import annotations

import io

from PIL import Image


def picture(frame: int, size: tuple[int, int] = (48, 32)) -> Image.Image:
    """Return an image whose brightness encodes the frame index."""
    return Image.new("RGB", size, (frame + 60,) * 3)


def png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()
