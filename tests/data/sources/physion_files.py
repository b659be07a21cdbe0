"""Writes small files in the layout of Physion's raw trials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from tests.data.sources.pictures import picture, png

IDS = (16_777_217, 3, 16_777_216)
"""Unsorted object ids, two of which are equal when rounded to float32."""
COLORS = np.array([[200, 10, 30], [20, 220, 90], [1, 2, 3]], np.uint8)
"""Colours of the objects in the segmentation images."""


BOUNDS = ("center", "left", "right", "front", "back")
"""Points of the objects' bounds, which some versions of the release have."""


def physion_trial(frames: int = 60) -> dict[str, Any]:
    """Three objects at rest on the floor; the y axis points up.

    `pairs` has for each frame the pairs of ids in contact, and `states` the state of each contact.
    `environment` has for each frame the ids that touch a wall or the floor, and `points` the normal
    and the point of each of these contacts. `hidden` has the indices of hidden objects by frame.
    """
    places = np.tile(np.float32([[-1, 0.5, 0], [0, 0.5, 1], [1, 0.5, 0]]), (frames, 1, 1))
    return {
        "stimulus_name": "pilot_it2_collision_box_0003",
        "models": [b"bowl", b"cone", b"bowl"],
        "positions": places,
        "rotations": np.tile(np.float32([0, 0, 0, 1]), (frames, 3, 1)),
        "velocities": np.zeros((frames, 3, 3), np.float32),
        "angular_velocities": np.zeros((frames, 3, 3), np.float32),
        "pairs": [[] for _ in range(frames)],
        "states": [[] for _ in range(frames)],
        "environment": [[] for _ in range(frames)],
        "points": [[] for _ in range(frames)],
        "hidden": {},
        "camera": (np.diag([1.0, 1.0, -1.0, 1.0]), np.float64(PROJECTION)),
    }


PROJECTION = [[1.5, 0, 0, 0], [0, 2, 0, 0], [0, 0, -1.002, -0.2], [0, 0, -1, 0]]


def write_physion(
    path: Path, trial: dict[str, Any], states: bool = True, suffix: str = "", first: int = 0
) -> Path:
    """Write a trial.

    Args:
        states: Write the states of contacts, which files of early versions lack.
        suffix: End of the keys of images and cameras in files of later versions.
        first: Number of the first frame; 1 in files of later versions.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        static = file.create_group("static")
        static["stimulus_name"] = trial["stimulus_name"]
        static["object_ids"] = np.array(IDS)
        static["model_names"] = trial["models"]
        static["object_segmentation_colors"] = trial.get("colors", COLORS)
        for key in ("scale", "framerate"):
            if key in trial:
                static[key] = trial[key]
        groups = file.create_group("frames")
        for k in range(len(trial["positions"])):
            _write_frame(groups.create_group(f"{k + first:04d}"), trial, k, states, suffix)
    return path


def _write_frame(group: h5py.Group, trial: dict, k: int, states: bool, suffix: str) -> None:
    segments = np.zeros((32, 48, 3), np.uint8)
    for n, color in enumerate(COLORS):
        if n not in trial["hidden"].get(k, ()):
            segments[4:8, 10 * n : 10 * n + 4] = color
    images = group.create_group("images")
    for key, image in (("_img", picture(k)), ("_id", Image.fromarray(segments))):
        images[key + suffix] = np.frombuffer(png(image), np.uint8)
    objects = group.create_group("objects")
    for key in ("positions", "rotations"):
        objects[key + suffix] = trial[key][k]
    for key in ("velocities", "angular_velocities", *BOUNDS):
        if trial.get(key) is not None:
            objects[key] = trial[key][k]
    collisions = group.create_group("collisions")
    collisions["object_ids"] = np.array(trial["pairs"][k], np.int32).reshape(-1, 2)
    if states:
        listed = np.array(trial["states"][k], "S5")
        collisions["states"] = listed if len(listed) else listed.reshape(0, 1)
    environment = group.create_group("env_collisions")
    listed_ids = np.array(trial["environment"][k], np.int32)
    environment["object_ids"] = listed_ids if len(listed_ids) else listed_ids.reshape(0, 1)
    environment["contacts"] = np.array(trial["points"][k], np.float32).reshape(-1, 2, 3)
    cameras = group.create_group("camera_matrices")
    for key, matrix in zip(("camera_matrix", "projection_matrix"), trial["camera"], strict=True):
        cameras[key + suffix] = np.float32(matrix).ravel()
