"""CLEVRER's release: an annotation (JSON) and a video (mp4) per scene.

    <folder>/annotation_train/annotation_00000-01000/annotation_00000.json
             video_train/video_00000-01000/video_00000.mp4

The folder of a video is the folder of its annotation with `video` in place of `annotation`, so
`annotations/train/...` beside `videos/train/...` can be read too.

`orientation` is read as angles in radians of rotations about the fixed x, y and z axes, in this
order, as in Bullet's getEulerFromQuaternion and Blender's rotation mode XYZ. Of a cylinder it turns
one whose axis is y: upright ones have [pi/2, 0, 0]. Velocities are per second of the simulation, of
which a frame lasts 0.028 s, while the video has 25 frames per second. Spheres, cylinders and cubes
have half heights of 0.2. `benchmarks/releases.py` measures this: in two scenes of the release,
displacements are 0.6997 times the velocities at 25 frames per second, and upright cylinders overlap
with the video by 0.93, lying ones by 0.73 and 0.80.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from PIL import Image
from pydantic import Field, conlist, constr

from dynapix.data.oracle.visibility import compute_visibility
from dynapix.data.records import COLORS, FPS, FRAMES, MATERIALS, SHAPES, Scene, SceneObject
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.shapes import CUBE_HALF
from dynapix.data.sources.validation import (
    Layout,
    RecordError,
    Vector,
    check_unique_objects,
    check_unique_scenes,
    find_contacts,
    read_layout,
    reconcile_velocities,
    scene_id,
)
from dynapix.data.sources.videos import describe_video, load_frames

FOLDER_CONTENTS = (
    "annotation_train/.../annotation_00000.json beside video_train/.../video_00000.mp4"
)
FRAME_SECONDS = 0.028
"""Simulated seconds per frame."""
RADIUS = 0.2
"""Radius of spheres and cylinders and half edge of cubes, simulator units."""


# The layout of an annotation.
class ObjectProperty(Layout):
    object_id: int
    shape: Literal[SHAPES]
    material: Literal[MATERIALS]
    color: Literal[COLORS]


class ObjectState(Layout):
    object_id: int
    location: Vector
    orientation: Vector
    velocity: Vector
    angular_velocity: Vector
    inside_camera_view: bool


class FrameStates(Layout):
    frame_id: int
    objects: list[ObjectState]


class Contact(Layout):
    object_ids: conlist(int, min_length=2, max_length=2)
    frame_id: Annotated[int, Field(ge=0, lt=FRAMES)]


class Annotation(Layout):
    scene_index: int | None = None
    video_filename: constr(pattern=r"^video_\d+\.mp4$")
    object_property: conlist(ObjectProperty, min_length=1)
    motion_trajectory: conlist(FrameStates, min_length=FRAMES, max_length=FRAMES)
    collision: list[Contact]


def list_scenes(folder: Path) -> list[Path]:
    """Return the paths of the annotations below a folder, in order of their numbers. A copy such as
    `annotation_00000 (1).json` has the number of its original."""
    paths = sorted(folder.rglob("annotation_*.json"), key=lambda path: (path.stem, path))
    return check_unique_scenes(folder, paths, _scene_id, FOLDER_CONTENTS)


def _scene_id(path: Path) -> str:
    number = path.stem.removeprefix("annotation_")
    return scene_id("clevrer", re.match(r"\d*", number).group() or number)


def read_scene(path: Path, folder: Path, split: str) -> Scene:
    """Return the scene of an annotation. Visible fractions are computed from the poses; whether an
    object is in view is read from the annotation."""
    from scipy.spatial.transform import Rotation

    annotation = read_layout(path, Annotation)
    number = Path(annotation.video_filename).stem.removeprefix("video_")
    index = annotation.scene_index
    if scene_id("clevrer", number) != _scene_id(path) or index not in (None, int(number)):
        raise RecordError(
            f"{path}: video_filename {annotation.video_filename!r} and scene_index {index} are not "
            "those of the file's number: as a copy of another scene, it would occur twice",
            "duplicate-scene",
        )
    ids = [each.object_id for each in annotation.object_property]
    check_unique_objects(str(path), ids)
    objects = tuple(SceneObject(o.shape, o.material, o.color) for o in annotation.object_property)
    touches = []
    for contact in annotation.collision:
        if len({*contact.object_ids} & {*ids}) < 2:
            raise RecordError(f"{path}: collision of {contact.object_ids}, expected two of {ids}")
        touches.append((contact.frame_id, [*map(ids.index, contact.object_ids)]))
    place = {name: k for k, name in enumerate(ids)}
    for index, frame in enumerate(annotation.motion_trajectory):
        frame.objects.sort(key=lambda state: place.get(state.object_id, len(ids)))
        listed = [state.object_id for state in frame.objects]
        if frame.frame_id != index or listed != ids:
            raise RecordError(
                f"{path}: frame {frame.frame_id} lists objects {listed}, expected frame {index} "
                f"with objects {ids}"
            )

    def array(key: str, dtype: type = np.float32) -> np.ndarray:
        frames = annotation.motion_trajectory
        return np.array([[getattr(s, key) for s in frame.objects] for frame in frames], dtype)

    footage = Path(str(path.relative_to(folder)).replace("annotation", "video"))
    footage = footage.with_name(annotation.video_filename)
    count = len(describe_video(folder / footage).times)
    if count != FRAMES:
        raise RecordError(f"{folder / footage} has {count} frames, expected {FRAMES}")
    quaternions = np.empty((FRAMES, len(ids), 4))
    for k, angles in enumerate(array("orientation").astype(float).swapaxes(0, 1)):
        turns = Rotation.from_euler("xyz", angles)
        if objects[k].shape == "cylinder":
            # Ours have the axis z. This rotation is first, in the cylinder's own coordinates.
            turns = turns * Rotation.from_euler("x", -np.pi / 2)
        quaternions[:, k] = turns.as_quat()
    camera, positions = Camera(), array("location").astype(np.float64)
    scales = tuple(RADIUS / CUBE_HALF if each.shape == "cube" else 1.0 for each in objects)
    _, fraction = compute_visibility(objects, positions, quaternions, camera, scales)
    rate = np.float32(FPS * FRAME_SECONDS)
    scene = Scene(
        scene_id=_scene_id(path),
        split=split,
        objects=objects,
        collisions=find_contacts(touches, len(ids), FPS),
        positions=array("location"),
        quaternions=quaternions.astype(np.float32),
        velocities=array("velocity") * rate,
        angular_velocities=array("angular_velocity") * rate,
        image_positions=camera.project(positions)[0].astype(np.float32),
        in_view=array("inside_camera_view", bool),
        visible_fraction=fraction.astype(np.float32),
        image_size=(camera.width, camera.height),
        footage=footage.as_posix(),
        scales=scales,
        radii=(RADIUS,) * len(objects),
    )
    return reconcile_velocities(scene, path)


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Return frames of a scene's video as RGB images, by frame index."""
    return load_frames(folder / str(scene.footage), frames)
