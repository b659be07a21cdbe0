"""Export scenes in the layout of CLEVRER's release, for loaders that were written for it."""

from __future__ import annotations

import io
import json
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from conf.errors import UserError
from data.parallel import Workers
from data.records import FPS, FRAMES, Scene
from data.releases.clevrer import EULER, VECTORS
from data.render.frame_cache import FrameCache, load_frames
from data.store import Store, load_scene, scene_path, write_atomically

NUMBERS = {"train": range(10_000), "test": range(10_000, 15_000)}
"""Range of scene numbers of each split: those of CLEVRER's train and validation parts."""
BLOCK = 1_000
"""Scenes per folder."""
QUALITY = "6"
"""Constant rate factor of x264; at this value compression losses are not visible."""


def export_clevrer(store: Store, folder: Path, workers: Workers) -> int:
    """Write every scene of a benchmark, with all its frames, in the layout of CLEVRER's release.

    Training scenes form the train part and test scenes the validation part. Scenes that are already
    in `folder` are not written again.

    Returns:
        The number of scenes in the release.

    Raises:
        UserError: CLEVRER's layout cannot hold this number of scenes, or one of the scenes.
    """
    indices = {}
    for split, numbers in NUMBERS.items():
        names = store.scene_ids(split)
        if len(names) > len(numbers):
            raise UserError(
                f"{store.name} has {len(names)} {split} scenes, but CLEVRER's layout holds at "
                f"most {len(numbers)}: export a smaller benchmark",
                code="too-many-scenes",
            )
        indices |= dict(zip(names, numbers, strict=False))
    cache = FrameCache.of(store)
    jobs = {
        name: partial(_export_one, cache, name, folder, index)
        for name, index in indices.items()
        if not annotation_path(folder, index).exists()
    }
    done = len(indices) - len(jobs)
    for _ in workers.run(jobs, "exporting scenes", "scene", done):
        pass
    return len(indices)


def _export_one(cache: FrameCache, scene_id: str, folder: Path, index: int) -> None:
    scene = load_scene(scene_path(cache.folder, scene_id))
    pixels = load_frames(cache.path(scene_id))
    pixels |= cache.render(scene_id, [f for f in range(scene.frames) if f not in pixels])
    write_clevrer(scene, {f: Image.fromarray(p) for f, p in pixels.items()}, folder, index)


def annotation_path(folder: Path, index: int) -> Path:
    """Return the path of the annotation of scene `index`."""
    part = "train" if index in NUMBERS["train"] else "validation"
    block = index // BLOCK * BLOCK
    span = f"{block:05d}-{block + BLOCK:05d}"
    return folder / f"annotation_{part}/annotation_{span}/annotation_{index:05d}.json"


def write_clevrer(
    scene: Scene, images: dict[int, Image.Image], folder: Path, index: int
) -> tuple[Path, Path]:
    """Write a scene and its frames as scene `index` of a release.

    The oracle does not record where two objects touched, so a collision's location is the middle of
    their centres.

    Returns:
        The paths of the annotation and of the video.

    Raises:
        UserError: CLEVRER's layout cannot hold the scene.
    """
    if scene.frames != FRAMES or sorted(images) != list(range(FRAMES)):
        raise UserError(
            f"scene {scene.scene_id} has {scene.frames} frames and {len(images)} images: CLEVRER's "
            f"scenes have {FRAMES} of each",
            code="invalid-scene",
        )
    annotation = annotation_path(folder, index)
    beside = str(annotation.relative_to(folder)).replace("annotation", "video")
    video = (folder / beside).with_suffix(".mp4")
    # The annotation is written last: a scene with an annotation is complete.
    write_atomically(video, _encode_video([images[frame] for frame in range(FRAMES)]))
    write_atomically(annotation, json.dumps(_annotation(scene, index, video.name)).encode())
    return annotation, video


def _annotation(scene: Scene, index: int, video: str) -> dict[str, Any]:
    vectors = {
        "location": scene.positions,
        "orientation": _angles(scene.quaternions),
        "velocity": scene.velocities,
        "angular_velocity": scene.angular_velocities,
    }
    return {
        "scene_index": index,
        "video_filename": video,
        "object_property": [
            {"object_id": k, "color": o.color, "material": o.material, "shape": o.shape}
            for k, o in enumerate(scene.objects)
        ],
        "motion_trajectory": [
            {
                "frame_id": frame,
                "objects": [
                    {
                        "object_id": k,
                        **{key: vectors[key][frame, k].tolist() for key in VECTORS},
                        "inside_camera_view": bool(scene.in_view[frame, k]),
                    }
                    for k in range(len(scene.objects))
                ],
            }
            for frame in range(scene.frames)
        ],
        "collision": [
            {
                "object_ids": list(c.objects),
                "frame_id": c.frame,
                "location": scene.positions[c.frame, list(c.objects)].mean(axis=0).tolist(),
            }
            for c in scene.collisions
        ],
    }


def _angles(quaternions: np.ndarray) -> np.ndarray:
    """Convert (..., 4) quaternions in x y z w order to (..., 3) radians, the inverse of
    `clevrer.angles_to_quaternions`."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(quaternions.reshape(-1, 4).astype(np.float64))
    with warnings.catch_warnings():
        # At gimbal lock several triples of angles describe the same rotation; any of them is valid.
        warnings.filterwarnings("ignore", "Gimbal lock")
        return rotations.as_euler(EULER).reshape(*quaternions.shape[:-1], 3)


def _encode_video(images: list[Image.Image]) -> bytes:
    """Encode images of one size as an mp4. Width and height must be even."""
    import av

    width, height = images[0].size
    if width % 2 or height % 2:
        raise UserError(
            f"a video of {width} x {height} px cannot be written: both must be even",
            code="invalid-size",
        )
    target = io.BytesIO()
    with av.open(target, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
    return target.getvalue()
