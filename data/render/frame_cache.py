"""(scene, frame) -> pixels. Rendered frames are read from the store's cache; one that is not there
is drawn from the oracle, which gives the same pixels.

A scene's cached frames are one archive: the first frame, and of each other one how it differs from
the first, pixel by pixel modulo 256, compressed by LZ4. What stands still in a scene differs
nowhere, so this is smaller than PNGs and read more than ten times as fast.
"""

from __future__ import annotations

import io
import json
import logging
import zipfile
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
from PIL import Image

from data.records import Scene
from data.releases.readers import READERS
from data.render import get_renderer
from data.store import Store, cached_scene, scene_path, write_atomically
from data.world.standins import standin_view

log = logging.getLogger(__name__)

CACHE_BYTES = 2 << 30
"""Memory that decoded frames may take in a process."""
_CODEC = "lz4"


def save_frames(frames: dict[int, np.ndarray], path: Path) -> None:
    """Write a scene's frames, (height, width, 3) uint8 each, as one archive."""
    first, *_ = ordered = sorted(frames)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.comment = json.dumps({"shape": frames[first].shape, "first": first}).encode()
        for frame in ordered:
            change = frames[frame] - frames[first] if frame != first else frames[first]
            packed = pa.compress(np.ascontiguousarray(change), codec=_CODEC, asbytes=True)
            archive.writestr(_member(frame), packed)
    write_atomically(path, buffer.getvalue())


def load_frames(path: Path, wanted: Iterable[int] | None = None) -> dict[int, np.ndarray]:
    """Those of the wanted frames that an archive holds, by frame index; every one for None. None
    where there is no archive, or where it is damaged, which is told."""
    try:
        with zipfile.ZipFile(path) as archive:
            about = json.loads(archive.comment)
            names = archive.NameToInfo
            if wanted is None:
                wanted = [int(name) for name in names]
            there = [f for f in wanted if str(_member(f).filename) in names]
            if not there:
                return {}
            first = _unpack(archive, about["first"], about["shape"])
            return {
                f: first if f == about["first"] else _unpack(archive, f, about["shape"]) + first
                for f in there
            }
    except FileNotFoundError:
        return {}
    except (zipfile.BadZipFile, ValueError, KeyError, OSError) as error:
        _tell_damaged(path, str(error))
        return {}


@cache
def _tell_damaged(path: Path, why: str) -> None:
    log.warning("%s is damaged (%s); its frames are drawn again", path, why)


def _member(frame: int) -> zipfile.ZipInfo:
    # Members carry a date; a fixed one keeps the same frames the same bytes.
    return zipfile.ZipInfo(f"{frame:03d}", (1980, 1, 1, 0, 0, 0))


def _unpack(archive: zipfile.ZipFile, frame: int, shape: list[int]) -> np.ndarray:
    packed = archive.read(_member(frame).filename)
    plain = pa.decompress(packed, int(np.prod(shape)), codec=_CODEC)
    return np.frombuffer(plain, np.uint8).reshape(shape)


@dataclass(frozen=True)
class FrameCache:
    """Where a store's rendered frames are, and how others are drawn."""

    folder: Path
    width: int
    height: int
    renderer: str
    simulator: str
    release: str | None
    """Folder of another simulator's release, whose frames are its own."""
    standin: str | None

    @classmethod
    def of(cls, store: Store) -> FrameCache:
        config = store.manifest["config"]
        keys = ("width", "height", "renderer", "simulator", "folder", "standin")
        return cls(store.folder, *(config.get(key) for key in keys))

    def path(self, scene_id: str) -> Path:
        return self.folder / "frames" / f"{scene_id}.zip"

    def draw(self, scene_id: str, frames: list[int]) -> dict[int, np.ndarray]:
        """Frames of a scene drawn from its oracle or read from its release, (height, width, 3)
        uint8 each."""
        if not frames:
            return {}
        scene = cached_scene(scene_path(self.folder, scene_id))
        if scene.footage is not None:
            images = READERS[self.simulator].load_images(scene, Path(self.release), frames)
            return {frame: np.asarray(image) for frame, image in images.items()}
        render = get_renderer(
            self.renderer, self.width, self.height, standin_view(self.standin)
        ).render
        return {frame: np.asarray(render(scene, frame)) for frame in frames}


class FrameReader:
    """Pixels of a store's frames, decoded once and kept as long as they are used."""

    def __init__(self, store: Store, size: int | None = None) -> None:
        """With `size`, frames come as squares of size x size px, as models are shown them."""
        self._store = store
        self._cache = FrameCache.of(store)
        self._size = size
        self._kept: OrderedDict[tuple[str, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def array(self, scene_id: str, frame: int) -> np.ndarray:
        """(height, width, 3) uint8."""
        return self.stack(scene_id, [frame])[0]

    def stack(self, scene_id: str, frames: list[int]) -> np.ndarray:
        """(T, height, width, 3) uint8."""
        missing = [f for f in dict.fromkeys(frames) if (scene_id, f) not in self._kept]
        if missing:
            for frame, pixels in zip(missing, self._load(scene_id, missing), strict=True):
                # Its own: a part of the stack would keep all of that.
                self._kept[scene_id, frame] = pixels.copy()
                self._bytes += pixels.nbytes
        stack = np.stack([self._kept[scene_id, frame] for frame in frames])
        for frame in frames:
            self._kept.move_to_end((scene_id, frame))
        while self._bytes > CACHE_BYTES:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return stack

    def scene(self, scene_id: str) -> Scene:
        return self._store.scene(scene_id)

    def image(self, scene_id: str, frame: int) -> Image.Image:
        return Image.fromarray(self.array(scene_id, frame))

    def _load(self, scene_id: str, frames: list[int]) -> np.ndarray:
        found = load_frames(self._cache.path(scene_id), frames)
        missing = [f for f in frames if f not in found]
        found |= self._cache.draw(scene_id, missing)
        pixels = np.stack([found[f] for f in frames])
        return pixels if self._size is None else resize_frames(pixels, self._size)


def resize_frames(pixels: np.ndarray, size: int) -> np.ndarray:
    """(T, size, size, 3) uint8 of (T, height, width, 3), as models are shown frames."""
    import torch
    from torchvision.transforms.v2 import InterpolationMode
    from torchvision.transforms.v2.functional import resize

    # Pillow gives the same to two levels of 255, frame by frame and five times as slowly.
    channels_first = torch.from_numpy(pixels).permute(0, 3, 1, 2)
    resize_frames = resize(channels_first, [size, size], InterpolationMode.BICUBIC, antialias=True)
    return resize_frames.permute(0, 2, 3, 1).contiguous().numpy()
