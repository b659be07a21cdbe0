"""Pixels of frames, which are read from the store's cache or, with the same result, rendered.

The cached frames of a scene are one archive. It contains the first frame, and the differences of
the other frames from the first (modulo 256), compressed with LZ4. Because most of an image does not
change, an archive is smaller than PNGs, and more than ten times as fast to read.
"""

from __future__ import annotations

import io
import json
import logging
import zipfile
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image

from dynapix.conf.errors import UserError
from dynapix.conf.files import write_bytes
from dynapix.data.records import Scene
from dynapix.data.render import get_renderer
from dynapix.data.store import FRAMES_FOLDER, Store

log = logging.getLogger(__name__)

CACHE_BYTES = 2 << 30
"""Maximum total size of the decoded frames that a `FrameReader` keeps in memory."""
_CODEC = "lz4"


def save_frames(frames: dict[int, np.ndarray], path: Path) -> None:
    """Write a scene's frames, each (height, width, 3) uint8, as one archive."""
    first, *_ = ordered = sorted(frames)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.comment = json.dumps({"shape": frames[first].shape, "first": first}).encode()
        for frame in ordered:
            difference = frames[frame] - frames[first] if frame != first else frames[first]
            packed = pa.compress(np.ascontiguousarray(difference), codec=_CODEC, asbytes=True)
            # ZipInfo has a fixed date, so that the same frames give the same bytes.
            archive.writestr(zipfile.ZipInfo(f"{frame:03d}"), packed)
    write_bytes(path, buffer.getvalue())


def load_frames(path: Path, wanted: Iterable[int] | None = None) -> dict[int, np.ndarray]:
    """Return those of the wanted frames (by default all) that an archive contains, by frame index:
    none if it is missing or damaged. A damaged archive is logged."""
    try:
        with zipfile.ZipFile(path) as archive:
            header = json.loads(archive.comment)
            available = dict.fromkeys(int(name) for name in archive.NameToInfo)
            present = [f for f in (available if wanted is None else wanted) if f in available]
            if not present:
                return {}
            first = _unpack(archive, header["first"], header["shape"])
            return {
                f: first if f == header["first"] else _unpack(archive, f, header["shape"]) + first
                for f in present
            }
    except FileNotFoundError:
        return {}
    except (zipfile.BadZipFile, ValueError, KeyError, OSError) as error:
        _warn_damaged(path, str(error))
        return {}


@cache
def _warn_damaged(path: Path, reason: str) -> None:
    log.warning("%s is damaged (%s); rendering its frames again", path, reason)


def _unpack(archive: zipfile.ZipFile, frame: int, shape: list[int]) -> np.ndarray:
    raw = pa.decompress(archive.read(f"{frame:03d}"), int(np.prod(shape)), codec=_CODEC)
    return np.frombuffer(raw, np.uint8).reshape(shape)


def frames_path(folder: Path, scene_id: str) -> Path:
    """Return the path of the archive of a scene's frames in a store."""
    return folder / FRAMES_FOLDER / f"{scene_id}.zip"


def render_frames(
    scene: Scene, frames: Sequence[int], config: Mapping[str, Any]
) -> dict[int, np.ndarray]:
    """Render frames of a scene of a benchmark with these settings, or read them from its release;
    return (height, width, 3) uint8 arrays by frame index."""
    if scene.footage is not None:
        # Reading the frames of simulated scenes does not need pydantic.
        from dynapix.data.sources.releases import READERS

        reader = READERS[config["simulator"]]
        images = reader.load_images(scene, Path(config["folder"]), frames)
    else:
        try:
            renderer = get_renderer(config)
        except ModuleNotFoundError as error:
            raise UserError(
                f"frames of scene {scene.scene_id} are not in the cache, and rendering them needs "
                f"{error.name}: pip install -e '.[simulate]'",
                code="missing-package",
            ) from error
        images = {frame: renderer.render(scene, frame) for frame in frames}
    return {frame: np.asarray(image) for frame, image in images.items()}


class FrameReader:
    """Reads the pixels of a store's frames and keeps the most recently used ones in memory."""

    def __init__(self, store: Store, size: int | None = None) -> None:
        """If `size` is given, frames are resized to size x size px, as inputs of a model."""
        self._store = store
        self._size = size
        self._decoded: OrderedDict[tuple[str, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def array(self, scene_id: str, frame: int) -> np.ndarray:
        """Return a frame as a (height, width, 3) uint8 array."""
        return self.stack(scene_id, [frame])[0]

    def stack(self, scene_id: str, frames: list[int]) -> np.ndarray:
        """Return frames of a scene as a (T, height, width, 3) uint8 array."""
        missing = [f for f in dict.fromkeys(frames) if (scene_id, f) not in self._decoded]
        if missing:
            for frame, pixels in zip(missing, self._load(scene_id, missing), strict=True):
                # A copy, because a view would keep all frames of the stack in memory.
                self._decoded[scene_id, frame] = pixels.copy()
                self._bytes += pixels.nbytes
        stack = np.stack([self._decoded[scene_id, frame] for frame in frames])
        for frame in frames:
            self._decoded.move_to_end((scene_id, frame))
        while self._bytes > CACHE_BYTES:
            self._bytes -= self._decoded.popitem(last=False)[1].nbytes
        return stack

    def scene(self, scene_id: str) -> Scene:
        return self._store.scene(scene_id)

    def image(self, scene_id: str, frame: int) -> Image.Image:
        return Image.fromarray(self.array(scene_id, frame))

    def _load(self, scene_id: str, frames: list[int]) -> np.ndarray:
        images = load_frames(frames_path(self._store.folder, scene_id), frames)
        if missing := [f for f in frames if f not in images]:
            images |= render_frames(self.scene(scene_id), missing, self._store.manifest["config"])
        pixels = np.stack([images[f] for f in frames])
        return pixels if self._size is None else resize_frames(pixels, self._size)


def encode_png(image: Image.Image) -> bytes:
    """Return an image as a PNG, compressed quickly."""
    png = io.BytesIO()
    image.save(png, "PNG", compress_level=1)
    return png.getvalue()


def resize_frames(pixels: np.ndarray, size: int) -> np.ndarray:
    """Resize (T, height, width, 3) uint8 frames to (T, size, size, 3), as inputs of a model.

    Without torchvision, Pillow resizes them, which takes five times as long. Of the values, 0.02%
    then differ, by at most 2 of 255.
    """
    try:
        import torch
        from torchvision.transforms.v2 import InterpolationMode
        from torchvision.transforms.v2.functional import resize
    except ModuleNotFoundError:
        images = [Image.fromarray(frame) for frame in pixels]
        resized = [image.resize((size, size), Image.Resampling.BICUBIC) for image in images]
        return np.stack([np.asarray(image) for image in resized])
    channels_first = torch.from_numpy(pixels).permute(0, 3, 1, 2)
    resized = resize(channels_first, [size, size], InterpolationMode.BICUBIC, antialias=True)
    return resized.permute(0, 2, 3, 1).contiguous().numpy()
