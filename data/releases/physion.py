"""Physion's raw trials, made with TDW: one HDF5 file a scene, anywhere below a folder.

TDW's axes are Unity's: y is up and the system is left-handed. Swapping y and z turns them into the
right-handed axes with z up that all else here has; being a reflection, the swap also turns round
the sense of rotations, and so the vector parts of quaternions and angular velocities.

The frame rate is not recorded: it was 30 a second in some versions and 100 in others, so that all
of this counts frames, and a caller says what `Scene.fps` is to be. Later versions name every
per-camera dataset with a suffix (`_img_cam0`) and begin at frame 0001.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from data.records import Scene, SceneObject
from data.releases import hdf5
from data.releases.physion_contacts import collisions, landings
from data.releases.validation import RecordError, check_unique_scenes, decode_image, scene_id

if TYPE_CHECKING:
    import h5py

LAYOUT = "an HDF5 file a trial, such as Collide/pilot_it2_collision/0000.hdf5"
FPS = 30
CAMERAS = ("", "_cam0")
"""What a version puts behind the names of per-camera datasets."""
SCENARIOS = {
    "domino": "Dominoes",
    "support": "Support",
    "tower": "Support",
    "colli": "Collide",
    "contain": "Contain",
    "drop": "Drop",
    "link": "Link",
    "roll": "Roll",
    "drape": "Drape",
    "cloth": "Drape",
}
"""Scenarios by what the names of their folders and stimuli hold."""
VECTORS = {"positions": 3, "rotations": 4, "velocities": 3, "angular_velocities": 3}


def list_scenes(folder: Path) -> list[Path]:
    """Trials below a folder, in order of their path.

    Raises:
        UserError: there are none.
    """
    found = sorted(path for end in ("hdf5", "h5") for path in folder.rglob(f"*.{end}"))
    return check_unique_scenes(folder, found, partial(_stimulus, folder=folder), LAYOUT)


def _stimulus(path: Path, folder: Path) -> str:
    """The path below the folder as one word, as TDW names a stimulus by its folder and number."""
    return "_".join(path.relative_to(folder).with_suffix("").parts)


def read_scene(path: Path, folder: Path, split: str, fps: float = FPS) -> Scene:
    """The scene of a trial. Objects are told apart by the name of their model; visible fractions
    are not known, and an object is in view where the segmentation image has its colour.

    Raises:
        RecordError: the file is not as Physion's trials are, or is cut off.
    """
    with hdf5.opened(path) as file:
        static, moments = hdf5.group(file, "static"), _moments(file)
        ids = hdf5.integers(static, "object_ids").tolist()
        models = [_text(name) for name in hdf5.dataset(static, "model_names")[()]]
        if len(models) != len(ids):
            raise RecordError(f"{path} names {len(models)} models of {len(ids)} objects")
        colors = hdf5.array(static, "object_segmentation_colors", shape=(len(ids), 3))
        columns = {
            key: np.stack([_of_objects(moment, key, (len(ids), n)) for moment in moments])
            for key, n in VECTORS.items()
        }
        stimulus = _stimulus(path, folder)
        told = _text(static["stimulus_name"][()]) if "stimulus_name" in static else ""
        scenario = _scenario(f"{stimulus} {told}", path)
        image_size = _image(moments[0], "_img").size
        scene = Scene(
            scene_id=scene_id("physion", scenario, stimulus),
            split=split,
            objects=tuple(SceneObject(model) for model in models),
            collisions=collisions(moments, ids),
            positions=upright(columns["positions"]),
            quaternions=turned(columns["rotations"]),
            velocities=upright(columns["velocities"]),
            angular_velocities=-upright(columns["angular_velocities"]),
            image_positions=np.stack(
                [
                    _projected(moment, places, image_size)
                    for moment, places in zip(moments, columns["positions"], strict=True)
                ]
            ),
            in_view=np.stack([_shown(moment, colors) for moment in moments]),
            visible_fraction=np.full((len(moments), len(ids)), np.nan, np.float32),
            image_size=image_size,
            fps=fps,
            landings=landings(moments, ids, columns["positions"]),
            scenario=scenario,
            footage=path.relative_to(folder).as_posix(),
        )
    check_frames(scene, folder)
    return scene


def upright(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) y up, left-handed -> z up, right-handed."""
    return vectors[..., [0, 2, 1]]


def turned(quaternions: np.ndarray) -> np.ndarray:
    """(..., 4) in x y z w order, y up, left-handed -> z up, right-handed."""
    return quaternions[..., [0, 2, 1, 3]] * np.float32([-1, -1, -1, 1])


def _scenario(names: str, path: Path) -> str:
    # Whole beginnings of words: a "controller" does not roll.
    found = re.search(f"(?<![a-z])(?i:{'|'.join(SCENARIOS)})", names)
    if found is None:
        known = ", ".join(dict.fromkeys(SCENARIOS.values()))
        raise RecordError(f"{path}: neither its path nor its stimulus name tells one of {known}")
    return SCENARIOS[found.group().lower()]


def _moments(file: h5py.File) -> list[h5py.Group]:
    """The groups of all frames in order."""
    frames = hdf5.group(file, "frames")
    names = sorted(frames)
    if names[:1] not in (["0000"], ["0001"]):
        raise RecordError(f"{hdf5.where(frames)} begins with {names[:1]}, expected 0000 or 0001")
    first = int(names[0])
    for k, name in enumerate(names):
        if name != f"{first + k:04d}":
            raise RecordError(f"{hdf5.where(frames)} has {name}, expected {first + k:04d} there")
    return [frames[name] for name in names]


def _projected(
    moment: h5py.Group, positions: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """(N, 2) px of the (N, 3) centres, in TDW's own axes, by the frame's camera."""
    cameras = hdf5.group(moment, "camera_matrices")
    world, lens = (
        hdf5.dataset(cameras, *_named(key))[()].reshape(-1).astype(np.float64)
        for key in ("camera_matrix", "projection_matrix")
    )
    if world.size != 16 or lens.size != 16:
        raise RecordError(
            f"{hdf5.where(cameras)} has matrices of {world.size} and {lens.size} numbers, expected "
            "16 each"
        )
    ends = np.concatenate([positions, np.ones((len(positions), 1))], axis=1)
    clip = ends @ (lens.reshape(4, 4) @ world.reshape(4, 4)).T
    # A point beside or behind the camera has no image; keep it finite and far outside.
    x, y = (clip[:, :2] / np.maximum(clip[:, 3:], 1e-3)).T
    return (np.stack([1 + x, 1 - y], axis=1) / 2 * image_size).astype(np.float32)


def _shown(moment: h5py.Group, colors: np.ndarray) -> np.ndarray:
    """(N,) whether the segmentation image has a pixel of each object's colour."""
    place = [1 << 16, 1 << 8, 1]
    codes = np.asarray(_image(moment, "_id")).astype(np.int32) @ place
    return np.array([(codes == code).any() for code in colors.astype(np.int32) @ place], bool)


def check_frames(scene: Scene, folder: Path) -> None:
    """Whether a trial has an image of each frame, without decoding any.

    Raises:
        RecordError: one is missing.
    """
    path = folder / str(scene.footage)
    with hdf5.opened(path) as file:
        moments = _moments(file)
        if len(moments) != scene.frames:
            raise RecordError(f"{path} has {len(moments)} frames, expected {scene.frames}")
        for moment in moments:
            hdf5.dataset(hdf5.group(moment, "images"), *_named("_img"))


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Frames of a trial as RGB images, by frame index, from 0 whatever the file calls its first.

    Raises:
        RecordError: one is missing or cannot be decoded.
    """
    path = folder / str(scene.footage)
    check_frames(scene, folder)
    with hdf5.opened(path) as file:
        moments = _moments(file)
        return {frame: _image(moments[frame], "_img") for frame in frames}


def _image(moment: h5py.Group, key: str) -> Image.Image:
    found = hdf5.dataset(hdf5.group(moment, "images"), *_named(key))
    return decode_image(found[()].tobytes(), hdf5.where(found))


def _of_objects(moment: h5py.Group, key: str, shape: tuple[int, int]) -> np.ndarray:
    return hdf5.array(hdf5.group(moment, "objects"), *_named(key), shape=shape)


def _named(key: str) -> list[str]:
    """What versions call a per-camera dataset."""
    return [key + camera for camera in CAMERAS]


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
