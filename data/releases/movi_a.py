"""MoVi-A's release, made with Kubric: 24 frames at 12 fps, in one of two forms.

    <folder>/00012/metadata.json events.json rgba_00000.png ...   as generated, a folder a scene
    <folder>/movi_a-train.tfrecord-00000-of-00512 ...             as TensorFlow Datasets has it

Contacts are listed for every point and substep. An index that is none of an object's (-1, or 65535
where it is unsigned) is the floor, or an object that is never seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from data.records import Landing, Scene
from data.releases import tfrecord
from data.releases.movi_a_formats import FPS, FRAMES, Example, from_folder, from_record
from data.releases.validation import RecordError, check_unique_scenes, decode_image, scene_id
from data.world.events import first_contacts

LAYOUT = (
    "a folder a scene with metadata.json, events.json and rgba_00000.png and so on, or "
    "movi_a-train.tfrecord-00000-of-00512 and so on"
)
FLOOR = 0.05
"""Contacts this near to height 0 may be the floor's, simulator units."""
UPRIGHT = 0.7
"""Least vertical share of a floor contact's normal."""


def list_scenes(folder: Path) -> list[Path]:
    """One path a scene, in order: its metadata.json, or a shard's path with the record's number
    behind it (`movi_a-train.tfrecord-00000-of-00512/00003`).

    Raises:
        UserError: there are none, or one scene twice.
    """
    # TensorFlow Datasets may write a metadata.json of its own.
    raw = [
        path
        for path in folder.rglob("metadata.json")
        if not path.with_name("dataset_info.json").exists()
    ]
    records = [
        shard / f"{number:05d}"
        for shard in folder.rglob("movi_a-*.tfrecord-*")
        for number in range(len(tfrecord.offsets(shard)))
    ]
    named = partial(_scene_id, folder=folder)
    return check_unique_scenes(folder, sorted(raw) + sorted(records), named, LAYOUT)


def _scene_id(path: Path, folder: Path) -> str:
    if path.name == "metadata.json":
        return scene_id("movi_a", *(path.parent.relative_to(folder).parts or (folder.name,)))
    split, _, shard = path.parent.name.removeprefix("movi_a-").partition(".tfrecord-")
    return scene_id("movi_a", split, shard.partition("-of-")[0], path.name)


def read_scene(path: Path, folder: Path, split: str) -> Scene:
    """The scene of a path that `list_scenes` gives. Visible fractions are not known; an object is
    in view where it has a pixel.

    Raises:
        RecordError: the scene is not as MoVi-A's release has it.
    """
    raw = path.name == "metadata.json"
    told = from_folder(path.parent) if raw else from_record(path)
    count = len(told.objects)
    real = (told.pairs >= 0) & (told.pairs < count)
    met = real.all(axis=1) & (told.frames < FRAMES)
    collisions = first_contacts(
        (int(frame), (int(a), int(b)))
        for frame, (a, b) in zip(told.frames[met], told.pairs[met], strict=True)
    )
    arrays = {key: array.swapaxes(0, 1) for key, array in told.arrays.items()}
    arrays["quaternions"] = np.roll(arrays["quaternions"], -1, axis=-1)
    arrays["image_positions"] = arrays["image_positions"] * np.float32(told.image_size)
    scene = Scene(
        scene_id=_scene_id(path, folder),
        split=split,
        objects=told.objects,
        collisions=collisions,
        **arrays,
        in_view=told.visibility.T > 0,
        visible_fraction=np.full((FRAMES, count), np.nan, np.float32),
        image_size=told.image_size,
        fps=FPS,
        landings=_landings(told, real),
        footage=(path.parent if raw else path).relative_to(folder).as_posix(),
    )
    check_frames(scene, folder)
    return scene


def _landings(told: Example, real: np.ndarray) -> tuple[Landing, ...]:
    """Each object's first contact with the floor. All objects begin in the air; one that the first
    frame shows on the floor does not land."""
    on_floor = (
        (real.sum(axis=1) == 1)
        & (np.abs(told.places[:, 2]) < FLOOR)
        & (np.abs(told.normals[:, 2]) > UPRIGHT)
    )
    frames, who = told.frames[on_floor], told.pairs[on_floor][real[on_floor]]
    first = [Landing(int(frames[who == k].min()), int(k)) for k in np.unique(who)]
    shown = [landing for landing in first if 0 < landing.frame < FRAMES]
    return tuple(sorted(shown, key=lambda landing: (landing.frame, landing.object)))


def check_frames(scene: Scene, folder: Path) -> None:
    """Whether a scene's frames are all there, without decoding any.

    Raises:
        RecordError: one is missing.
    """
    place = folder / str(scene.footage)
    if place.is_dir():
        missing = [
            path for f in range(scene.frames) if not (path := _frame_file(place, f)).exists()
        ]
        if missing:
            raise RecordError(
                f"{missing[0]} is missing, {len(missing)} of {scene.frames} frames are"
            )
        return
    count = len(_video(place))
    if count != scene.frames:
        raise RecordError(f"{place} has a video of {count} frames, expected {scene.frames}")


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Frames of a scene as RGB images, by frame index.

    Raises:
        RecordError: one is missing or cannot be decoded.
    """
    place = folder / str(scene.footage)
    check_frames(scene, folder)
    if place.is_dir():
        files = {frame: _frame_file(place, frame) for frame in frames}
        return {frame: decode_image(file.read_bytes(), str(file)) for frame, file in files.items()}
    video = _video(place)
    return {frame: decode_image(video[frame], f"{place}: frame {frame}") for frame in frames}


def _frame_file(place: Path, frame: int) -> Path:
    return place / f"rgba_{frame:05d}.png"


def _video(place: Path) -> list[bytes]:
    """
    Raises:
        RecordError: neither a folder of frames nor a file of records is where it was.
    """
    if not place.parent.is_file():
        raise RecordError(f"{place} is missing")
    return list(tfrecord.example(place.parent, int(place.name), ("video",)).get("video", []))
