"""Writes small files in the layout of CLEVRER's release."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.data.sources.pictures import write_video


def clevrer_annotation(index: int = 0) -> dict[str, Any]:
    """An annotation: a cube rests at the origin, and a sphere rolls along y and out of view.

    As in the release, velocities are per second of the simulation, of which a frame lasts 0.028 s.
    """

    def states(f: int) -> list[dict[str, Any]]:
        zero = [0.0, 0.0, 0.0]
        still = {"location": [0.0, 0.0, 0.0], "orientation": [0.3, -0.5, 1.1]}
        rolling = {"location": [0.5, 0.05 * f - 1, 0.2], "orientation": [-0.25 * f, 0.0, 0.0]}
        still |= {"velocity": zero, "angular_velocity": zero}
        rates = {"velocity": [0.0, 0.05, 0.0], "angular_velocity": [-0.25, 0.0, 0.0]}
        rolling |= {key: [x / 0.028 for x in rate] for key, rate in rates.items()}
        return [
            {"object_id": 0, "inside_camera_view": True, **still},
            {"object_id": 1, "inside_camera_view": f < 90, **rolling},
        ]

    return {
        "scene_index": index,
        "video_filename": f"video_{index:05d}.mp4",
        "object_property": [
            {"object_id": 0, "color": "red", "material": "metal", "shape": "cube"},
            {"object_id": 1, "color": "blue", "material": "rubber", "shape": "sphere"},
        ],
        "motion_trajectory": [{"frame_id": f, "objects": states(f)} for f in range(128)],
        "collision": [{"object_ids": [1, 0], "frame_id": 20, "location": [0.25, 0.0, 0.2]}],
    }


def write_clevrer_scene(
    folder: Path, record: Any, index: int = 0, video_frames: int = 128
) -> tuple[Path, Path]:
    """Write an annotation, a record or its text, and a video. Return the paths of both files."""
    span = f"{index // 1000 * 1000:05d}-{index // 1000 * 1000 + 1000:05d}"
    annotation = folder / f"annotation_train/annotation_{span}/annotation_{index:05d}.json"
    annotation.parent.mkdir(parents=True, exist_ok=True)
    annotation.write_text(record if isinstance(record, str) else json.dumps(record))
    video = folder / f"video_train/video_{span}/video_{index:05d}.mp4"
    write_video(video, video_frames)
    return annotation, video
