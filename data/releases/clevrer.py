"""CLEVRER's release: an annotation (JSON) and a video (mp4) per scene.

    <folder>/annotation_train/annotation_00000-01000/annotation_00000.json
             video_train/video_00000-01000/video_00000.mp4

The path of a video is that of its annotation with `video` in place of `annotation`, so
`annotations/train/...` beside `videos/train/...` is read too.

`orientation` is read as angles in radians about the fixed x, y and z axes, in this order: the
convention of Bullet's getEulerFromQuaternion and of Blender's rotation mode XYZ.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from data.records import COLORS, FRAMES, MATERIALS, SHAPES, Collision, Scene, SceneObject
from data.releases.validation import (
    RecordError,
    check_choice,
    check_unique_scenes,
    finite_array,
    get_field,
    load_json,
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
APPEARANCE = {"shape": SHAPES, "material": MATERIALS, "color": COLORS}
VECTORS = ("location", "orientation", "velocity", "angular_velocity")
EULER = "xyz"
"""scipy's name of the angles about fixed x, y and z axes."""


def list_scenes(folder: Path) -> list[Path]:
    """Return the annotations below a folder, in order of their number.

    Raises:
        UserError: The folder contains no annotation, or a number twice.
    """
    paths = sorted(folder.rglob("annotation_*.json"), key=lambda path: (path.stem, path))
    return check_unique_scenes(folder, paths, _scene_id, LAYOUT)


def _scene_id(path: Path) -> str:
    return scene_id("clevrer", path.stem.removeprefix("annotation_"))


def read_scene(path: Path, folder: Path, split: str) -> Scene:
    """Return the scene of an annotation.

    Visible fractions are computed from the poses; whether an object is in view is the annotation's
    flag.

    Raises:
        RecordError: The annotation or its video does not have the layout of CLEVRER's release.
    """
    record = load_json(path)
    if "collisions" in record:
        raise RecordError(
            f"{path} has the key 'collisions' instead of CLEVRER's 'collision': the file is from "
            "another generator"
        )
    looks = _read_objects(record, path)
    ids, objects = list(looks), tuple(looks.values())
    states = _read_states(record, ids, path)
    quaternions = angles_to_quaternions(states["orientation"])
    positions = states["location"].astype(np.float64)
    camera = Camera()
    image_positions, _ = camera.project(positions)
    _, fraction = compute_visibility(objects, positions, quaternions, camera)
    video = Path(str(path.relative_to(folder)).replace("annotation", "video"))
    scene = Scene(
        scene_id=_scene_id(path),
        split=split,
        objects=objects,
        collisions=_read_collisions(record, ids, path),
        positions=states["location"],
        quaternions=quaternions.astype(np.float32),
        velocities=states["velocity"],
        angular_velocities=states["angular_velocity"],
        image_positions=image_positions.astype(np.float32),
        in_view=states["inside_camera_view"],
        visible_fraction=fraction.astype(np.float32),
        image_size=(camera.width, camera.height),
        footage=video.with_name(get_field(record, "video_filename", str, str(path))).as_posix(),
    )
    check_frames(scene, folder)
    return scene


def _read_objects(record: dict[str, Any], path: Path) -> dict[int, SceneObject]:
    """Appearances by object id."""
    objects = {}
    where = f"{path}: object_property"
    for entry in get_field(record, "object_property", list, str(path)):
        look = {
            key: check_choice(get_field(entry, key, str, where), choices, f"{where}: {key}")
            for key, choices in APPEARANCE.items()
        }
        objects[get_field(entry, "object_id", int, where)] = SceneObject(**look)
    return objects


def _read_states(record: dict[str, Any], ids: list[int], path: Path) -> dict[str, np.ndarray]:
    """(F, N, 3) arrays of the vectors, and the (F, N) view flags."""
    trajectory = get_field(record, "motion_trajectory", list, str(path))
    where = f"{path}: motion_trajectory"
    frame_ids = [get_field(moment, "frame_id", int, where) for moment in trajectory]
    if frame_ids != list(range(FRAMES)):
        raise RecordError(f"{path} has {len(frame_ids)} frames, expected 0 to {FRAMES - 1}")
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
            kind = list if key in VECTORS else bool
            rows.append([get_field(by_id[k], key, kind, where) for k in ids])
    if any(len(angles) == 4 for row in columns["orientation"] for angles in row):
        raise RecordError(
            f"{path} has orientations of four numbers instead of CLEVRER's three angles: the file "
            "is from another generator"
        )
    shape = (FRAMES, len(ids), 3)
    states = {key: finite_array(columns[key], shape, f"{path}: {key}") for key in VECTORS}
    return states | {"inside_camera_view": np.array(columns["inside_camera_view"], bool)}


def angles_to_quaternions(angles: np.ndarray) -> np.ndarray:
    """Convert (..., 3) radians to (..., 4) quaternions in x y z w order."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_euler(EULER, angles.reshape(-1, 3).astype(np.float64))
    return rotations.as_quat().reshape(*angles.shape[:-1], 4)


def _read_collisions(record: dict[str, Any], ids: list[int], path: Path) -> tuple[Collision, ...]:
    collisions = []
    where = f"{path}: collision"
    for event in get_field(record, "collision", list, str(path)):
        frame = get_field(event, "frame_id", int, where)
        pair = get_field(event, "object_ids", list, where)
        if not 0 <= frame < FRAMES or len(pair) != 2 or not set(pair) <= set(ids):
            raise RecordError(
                f"{where}: objects {pair} at frame {frame}, expected two of {ids} at 0 to "
                f"{FRAMES - 1}"
            )
        first, second = sorted(ids.index(k) for k in pair)
        collisions.append(Collision(frame, (first, second)))
    return tuple(sorted(collisions, key=lambda c: (c.frame, c.objects)))


def check_frames(scene: Scene, folder: Path) -> None:
    """Check that a scene's video has every frame, without decoding it.

    Raises:
        RecordError: The video is missing, unreadable, or has another number of frames.
    """
    with _open_video(scene, folder) as video:
        count = sum(packet.size > 0 for packet in video.demux(video=0))
    if count != scene.frames:
        raise RecordError(
            f"{folder / str(scene.footage)} has {count} frames, expected {scene.frames}"
        )


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Return frames of a scene's video as RGB images, by frame index.

    Raises:
        RecordError: The video cannot be decoded up to the last of them.
    """
    missing = set(frames)
    images: dict[int, Image.Image] = {}
    if not missing:
        return images
    with _open_video(scene, folder) as video:
        for index, frame in enumerate(video.decode(video=0)):
            if index in missing:
                images[index] = frame.to_image()
                missing.remove(index)
            if not missing:
                return images
    path = folder / str(scene.footage)
    raise RecordError(f"{path} ends before frame {min(missing)}", "damaged-file")


@contextmanager
def _open_video(scene: Scene, folder: Path) -> Iterator[InputContainer]:
    import av

    path = folder / str(scene.footage)
    if not path.is_file():
        raise RecordError(
            f"{path} is missing: the annotation names it as its video", "missing-file"
        )
    try:
        with av.open(str(path)) as video:
            if not video.streams.video:
                raise RecordError(f"{path} contains no video")
            yield video
    except av.FFmpegError as error:
        reason = error.strerror or error
        raise RecordError(f"{path} cannot be decoded: {reason}", "damaged-file") from error
