"""CLEVRER's release: an annotation (JSON) and a video (mp4) a scene.

    <folder>/annotation_train/annotation_00000-01000/annotation_00000.json
             video_train/video_00000-01000/video_00000.mp4

Videos lie where `annotation` reads `video` in the annotation's path, so `annotations/train/...`
beside `videos/train/...` is read as well.

`orientation` is taken as angles about the fixed x, y and z axes in that order, in radians: what
Bullet's getEulerFromQuaternion gives and Blender's rotation mode XYZ takes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from data.records import COLORS, FRAMES, MATERIALS, SHAPES, Collision, Scene, SceneObject
from data.releases.validation import (
    RecordError,
    check_unique_scenes,
    finite_array,
    get_field,
    scene_id,
)
from data.world.camera import Camera
from data.world.visibility import compute_visibility

if TYPE_CHECKING:
    from av.container import InputContainer

LAYOUT = (
    "annotation_train/annotation_00000-01000/annotation_00000.json and so on beside "
    "video_train/video_00000-01000/video_00000.mp4"
)
VECTORS = ("location", "orientation", "velocity", "angular_velocity")
EULER = "xyz"
"""scipy's word for angles about fixed x, y and z axes."""


def list_scenes(folder: Path) -> list[Path]:
    """Annotations below a folder, in order of their number.

    Raises:
        UserError: there are none, or one number twice.
    """
    found = sorted(folder.rglob("annotation_*.json"), key=lambda path: (path.stem, path))
    return check_unique_scenes(folder, found, _scene_id, LAYOUT)


def _scene_id(path: Path) -> str:
    return scene_id("clevrer", path.stem.removeprefix("annotation_"))


def read_scene(path: Path, folder: Path, split: str) -> Scene:
    """The scene of an annotation. Visible fractions are counted from poses, as for scenes of one's
    own; whether an object is in view is as the annotation says.

    Raises:
        RecordError: the annotation or its video is not as CLEVRER's release has them.
    """
    record = _parsed(path)
    if "collisions" in record:
        raise RecordError(
            f"{path} has the key 'collisions' where CLEVRER's release has 'collision': it is "
            "another generator's file"
        )
    objects = _objects(record, path)
    states = _states(record, list(objects), path)
    looks = tuple(objects.values())
    poses = states["location"].astype(np.float64), quaternions(states["orientation"])
    camera = Camera()
    image_positions, _ = camera.project(poses[0])
    _, fraction = compute_visibility(looks, *poses, camera)
    video = get_field(record, "video_filename", str, str(path))
    beside = Path(str(path.relative_to(folder)).replace("annotation", "video"))
    scene = Scene(
        scene_id=_scene_id(path),
        split=split,
        objects=looks,
        collisions=_collisions(record, list(objects), path),
        positions=states["location"],
        quaternions=poses[1].astype(np.float32),
        velocities=states["velocity"],
        angular_velocities=states["angular_velocity"],
        image_positions=image_positions.astype(np.float32),
        in_view=states["inside_camera_view"],
        visible_fraction=fraction.astype(np.float32),
        image_size=(camera.width, camera.height),
        footage=beside.with_name(video).as_posix(),
    )
    check_frames(scene, folder)
    return scene


def _parsed(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_bytes())
    except ValueError as error:
        raise RecordError(f"{path} is not whole, or no JSON: {error}") from error
    if not isinstance(record, dict):
        raise RecordError(f"{path} holds a {type(record).__name__}, expected an object with keys")
    return record


def _objects(record: dict[str, Any], path: Path) -> dict[int, SceneObject]:
    """What objects look like, by object id."""
    found = {}
    for listed in get_field(record, "object_property", list, str(path)):
        where = f"{path}: object_property"
        look = {
            key: _one_of(get_field(listed, key, str, where), key, known, path)
            for key, known in (("shape", SHAPES), ("material", MATERIALS), ("color", COLORS))
        }
        found[get_field(listed, "object_id", int, where)] = SceneObject(**look)
    return found


def _one_of(word: str, key: str, known: tuple[str, ...], path: Path) -> str:
    if word not in known:
        raise RecordError(f"{path} has an object of {key} {word!r}, expected {', '.join(known)}")
    return word


def _states(record: dict[str, Any], ids: list[int], path: Path) -> dict[str, np.ndarray]:
    """(F, N, 3) arrays of the vectors, and (F, N) whether an object is in view."""
    trajectory = get_field(record, "motion_trajectory", list, str(path))
    where = f"{path}: motion_trajectory"
    numbered = [get_field(moment, "frame_id", int, where) for moment in trajectory]
    if numbered != list(range(FRAMES)):
        raise RecordError(f"{path} has {len(numbered)} frames, expected 0 to {FRAMES - 1} in order")
    columns: dict[str, list[list[Any]]] = {key: [] for key in (*VECTORS, "inside_camera_view")}
    for frame, moment in enumerate(trajectory):
        where = f"{path}: frame {frame}"
        by_id = {
            get_field(state, "object_id", int, where): state
            for state in get_field(moment, "objects", list, where)
        }
        if sorted(by_id) != sorted(ids):
            raise RecordError(f"{where} lists objects {sorted(by_id)}, expected {sorted(ids)}")
        for key, rows in columns.items():
            kind = bool if key == "inside_camera_view" else list
            rows.append([get_field(by_id[k], key, kind, where) for k in ids])
    if any(len(angles) == 4 for row in columns["orientation"] for angles in row):
        raise RecordError(
            f"{path} has orientations of four numbers where CLEVRER's release has three angles: it "
            "is another generator's file"
        )
    shape = (FRAMES, len(ids), 3)
    return {
        **{key: finite_array(columns[key], shape, f"{path}: values of {key!r}") for key in VECTORS},
        "inside_camera_view": np.array(columns["inside_camera_view"], bool),
    }


def quaternions(angles: np.ndarray) -> np.ndarray:
    """(..., 3) radians -> (..., 4) quaternions in x y z w order."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_euler(EULER, angles.reshape(-1, 3).astype(np.float64))
    return turns.as_quat().reshape(*angles.shape[:-1], 4)


def _collisions(record: dict[str, Any], ids: list[int], path: Path) -> tuple[Collision, ...]:
    found = []
    for event in get_field(record, "collision", list, str(path)):
        where = f"{path}: collision"
        frame, pair = (
            get_field(event, "frame_id", int, where),
            get_field(event, "object_ids", list, where),
        )
        if not 0 <= frame < FRAMES or len(pair) != 2 or not set(pair) <= set(ids):
            raise RecordError(
                f"{where} is of objects {pair} at frame {frame}, expected two of {ids} at 0 to "
                f"{FRAMES - 1}"
            )
        first, second = sorted(ids.index(k) for k in pair)
        found.append(Collision(frame, (first, second)))
    return tuple(sorted(found, key=lambda c: (c.frame, c.objects)))


def check_frames(scene: Scene, folder: Path) -> None:
    """Whether a scene's video is there with every frame, counted without decoding any.

    Raises:
        RecordError: it is missing, cannot be read, or has another number of frames.
    """
    with _opened(scene, folder) as video:
        count = sum(packet.size > 0 for packet in video.demux(video=0))
    if count != scene.frames:
        path = folder / str(scene.footage)
        raise RecordError(f"{path} has {count} frames, expected {scene.frames}")


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Frames of a scene's video as RGB images, by frame index.

    Raises:
        RecordError: the video cannot be decoded up to the last of them.
    """
    wanted = set(frames)
    found: dict[int, Image.Image] = {}
    with _opened(scene, folder) as video:
        for index, frame in enumerate(video.decode(video=0)):
            if index in wanted:
                found[index] = frame.to_image()
            if len(found) == len(wanted):
                break
    if wanted != found.keys():
        path = folder / str(scene.footage)
        raise RecordError(f"{path} ends before frame {min(wanted - found.keys())}")
    return found


@contextmanager
def _opened(scene: Scene, folder: Path) -> Iterator[InputContainer]:
    import av

    path = folder / str(scene.footage)
    if not path.is_file():
        raise RecordError(f"{path} is missing: the annotation names it as its video")
    try:
        with av.open(str(path)) as video:
            if not video.streams.video:
                raise RecordError(f"{path} holds no video")
            yield video
    except av.FFmpegError as error:
        raise RecordError(f"{path} cannot be decoded: {error.strerror or error}") from error
