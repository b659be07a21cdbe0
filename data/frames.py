"""(scene, frame) -> pixels. Rendered frames are read from the store; one that was not rendered
ahead is drawn from the oracle, which gives the same pixels."""

from __future__ import annotations

import io
import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image

from data.records import Scene
from data.store import Store, write_atomically

# Zip members carry a date; a fixed one keeps the same frames the same bytes.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def save_frames(images: dict[int, Image.Image], path: Path) -> None:
    """Write a scene's frames as one archive of PNGs, in the order given."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for frame, image in images.items():
            png = io.BytesIO()
            image.save(png, "PNG", compress_level=1)
            archive.writestr(zipfile.ZipInfo(f"{frame:03d}.png", _EPOCH), png.getvalue())
    write_atomically(path, buffer.getvalue())


def load_frames(path: Path) -> dict[int, Image.Image]:
    """Every frame of an archive, by frame index."""
    with zipfile.ZipFile(path) as archive:
        return {
            int(name[:-4]): Image.open(io.BytesIO(archive.read(name))).convert("RGB")
            for name in archive.namelist()
        }


CACHE_BYTES = 2 << 30
"""Memory that decoded frames may take in a process."""


class Frames:
    """Pixels of a store's frames, decoded once and kept as long as they are used."""

    def __init__(self, store: Store, size: int | None = None) -> None:
        """With `size`, frames come as squares of size x size px, as models are shown them."""
        self._store = store
        self._size = size
        config = store.manifest["config"]
        frame_bytes = 3 * (size * size if size else config["width"] * config["height"])
        self._get = lru_cache(maxsize=CACHE_BYTES // frame_bytes)(self._load)

    def array(self, scene_id: str, frame: int) -> np.ndarray:
        """(height, width, 3) uint8."""
        return self._get(scene_id, frame)

    def stack(self, scene_id: str, frames: list[int]) -> np.ndarray:
        """(T, height, width, 3) uint8."""
        return np.stack([self.array(scene_id, frame) for frame in frames])

    def image(self, scene_id: str, frame: int) -> Image.Image:
        return Image.fromarray(self.array(scene_id, frame))

    def _load(self, scene_id: str, frame: int) -> np.ndarray:
        image = self._read(scene_id, frame) or self._draw(self._store.scene(scene_id), frame)
        if self._size is not None:
            image = image.resize((self._size, self._size), Image.Resampling.BICUBIC)
        return np.array(image)

    def _read(self, scene_id: str, frame: int) -> Image.Image | None:
        path = self._store.folder / "frames" / f"{scene_id}.zip"
        if not path.exists():
            return None
        with zipfile.ZipFile(path) as archive:
            try:
                png = archive.read(f"{frame:03d}.png")
            except KeyError:
                return None
        return Image.open(io.BytesIO(png)).convert("RGB")

    def _draw(self, scene: Scene, frame: int) -> Image.Image:
        from data.render import renderer

        config = self._store.manifest["config"]
        return renderer(config["width"], config["height"]).render(scene, frame)
