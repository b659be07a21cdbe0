"""The two forms in which a scene of MoVi-A is published, each turned into the same arrays.

The physics runs from scene frame 0 and rendering begins at scene frame 1: frame i of the video, and
of every array, is scene frame i + 1. A contact's time counts scene frames from 0. As generated it
is a float; TensorFlow Datasets cuts it to an integer, so that the first frame that is surely at or
after the contact is the next one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data.records import SceneObject
from data.releases import tfrecord
from data.releases.validation import RecordError, finite_array, get_field

FRAMES, FPS = 24, 12
LABELS = {
    "shape": ("cube", "cylinder", "sphere"),
    "material": ("metal", "rubber"),
    "color": ("blue", "brown", "cyan", "gray", "green", "purple", "red", "yellow"),
    "size": ("small", "large"),
}
"""What objects look like, in the order in which TensorFlow Datasets numbers the words."""
RAW_KEYS = {
    "shape": "shape",
    "material": "material",
    "color": "color_label",
    "size": "size_label",
}
WIDTHS = {
    "positions": 3,
    "quaternions": 4,
    "velocities": 3,
    "angular_velocities": 3,
    "image_positions": 2,
}
"""Numbers a frame and object of each array."""


@dataclass(frozen=True)
class Example:
    """What both forms tell of a scene: arrays (N, F, ...) of N objects, rows of contact points."""

    objects: tuple[SceneObject, ...]
    image_size: tuple[int, int]
    arrays: dict[str, np.ndarray]
    visibility: np.ndarray
    pairs: np.ndarray
    frames: np.ndarray
    """(M,) the first frame of the video at or after each contact."""
    places: np.ndarray
    normals: np.ndarray


def from_folder(folder: Path) -> Example:
    metadata, events = (_parsed(folder / name) for name in ("metadata.json", "events.json"))
    where = str(folder / "metadata.json")
    about = get_field(metadata, "metadata", dict, where)
    _check_clock(
        get_field(about, "num_frames", int, where),
        get_field(about, "frame_rate", int, where),
        where,
    )
    width, height = finite_array(
        get_field(about, "resolution", list, where), (2,), f"{where}: resolution"
    )
    instances = get_field(metadata, "instances", list, where)
    looks = tuple(
        SceneObject(**{axis: get_field(i, key, str, where) for axis, key in RAW_KEYS.items()})
        for i in instances
    )
    for look in looks:
        for axis, words in LABELS.items():
            if getattr(look, axis) not in words:
                raise RecordError(
                    f"{where} has an object of {axis} {getattr(look, axis)!r}, expected "
                    f"{', '.join(words)}"
                )

    def stacked(key: str, *tail: int) -> np.ndarray:
        values = [get_field(i, key, list, where) for i in instances]
        return finite_array(values, (len(looks), FRAMES, *tail), f"{where}: {key}")

    where_events = str(folder / "events.json")
    contacts = get_field(events, "collisions", list, where_events)

    def column(key: str, *tail: int) -> np.ndarray:
        values = [get_field(c, key, list if tail else float, where_events) for c in contacts]
        return finite_array(values, (len(contacts), *tail), f"{where_events}: {key}")

    return Example(
        objects=looks,
        image_size=(int(width), int(height)),
        arrays={key: stacked(key, size) for key, size in WIDTHS.items()},
        visibility=stacked("visibility"),
        pairs=column("instances", 2).astype(int),
        frames=np.maximum(np.ceil(column("frame")).astype(int) - 1, 0),
        places=column("position", 3),
        normals=column("contact_normal", 3),
    )


def _parsed(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing, which a scene of MoVi-A has") from error
    except ValueError as error:
        raise RecordError(f"{path} is not whole, or no JSON: {error}") from error


def _check_clock(frames: int, rate: int, where: str) -> None:
    if (frames, rate) != (FRAMES, FPS):
        raise RecordError(
            f"{where} tells of {frames} frames at {rate} a second, expected {FRAMES} at {FPS}"
        )


def from_record(path: Path) -> Example:
    about = ("num_frames", "num_instances", "width", "height")
    labels = [f"{axis}_label" for axis in LABELS]
    contacts = ("instances", "frame", "position", "contact_normal")
    names = (
        *(f"metadata/{key}" for key in about),
        *(f"instances/{key}" for key in (*WIDTHS, "visibility", *labels)),
        *(f"events/collisions/{key}" for key in contacts),
    )
    found = tfrecord.example(path.parent, int(path.name), names)
    where = f"{path.parent}: record {int(path.name)}"
    missing = [name for name in names if name not in found]
    if missing:
        raise RecordError(f"{where} lacks the feature {missing[0]!r} that MoVi-A's release has")

    def of(name: str, *shape: int) -> np.ndarray:
        values, size = found[name], int(np.prod(shape))
        if len(values) != size:
            raise RecordError(f"{where} has {len(values)} values of {name!r}, expected {size}")
        return finite_array(np.reshape(values, shape), shape, f"{where}: {name}")

    frames, count, width, height = (int(of(f"metadata/{key}")) for key in about)
    _check_clock(frames, FPS, where)
    looks = {axis: of(f"instances/{axis}_label", count).astype(int) for axis in LABELS}
    for axis, words in LABELS.items():
        if not ((looks[axis] >= 0) & (looks[axis] < len(words))).all():
            raise RecordError(
                f"{where} numbers a {axis} {looks[axis].max()}, of {len(words)} words"
            )
    rows = len(found["events/collisions/frame"])
    return Example(
        objects=tuple(
            SceneObject(**{axis: words[looks[axis][k]] for axis, words in LABELS.items()})
            for k in range(count)
        ),
        image_size=(width, height),
        arrays={key: of(f"instances/{key}", count, FRAMES, size) for key, size in WIDTHS.items()},
        visibility=of("instances/visibility", count, FRAMES),
        pairs=of("events/collisions/instances", rows, 2).astype(int),
        frames=of("events/collisions/frame", rows).astype(int),
        places=of("events/collisions/position", rows, 3),
        normals=of("events/collisions/contact_normal", rows, 3),
    )
