"""The two formats of a MoVi-A scene, both read into the same arrays.

The physics starts at scene frame 0 and the rendering at scene frame 1: frame i of the video, and of
every array, is scene frame i + 1. The time of a contact counts scene frames from 0. It is a float
in Kubric's format; TensorFlow Datasets truncates it, so that the next frame is the first that is
certainly at or after the contact.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data.records import SceneObject
from data.releases.tfrecord import feature_values, read_example
from data.releases.validation import RecordError, check_choice, finite_array, get_field, load_json

FRAMES, FPS = 24, 12
APPEARANCE = {
    "shape": ("cube", "cylinder", "sphere"),
    "material": ("metal", "rubber"),
    "color": ("blue", "brown", "cyan", "gray", "green", "purple", "red", "yellow"),
    "size": ("small", "large"),
}
"""Words of each attribute, in the order in which TensorFlow Datasets numbers them."""
KUBRIC_KEYS = {
    "shape": "shape",
    "material": "material",
    "color": "color_label",
    "size": "size_label",
}
ARRAYS = {
    "positions": (3,),
    "quaternions": (4,),
    "velocities": (3,),
    "angular_velocities": (3,),
    "image_positions": (2,),
    "visibility": (),
}
"""Shape of each array per object and frame."""


@dataclass(frozen=True)
class MoviExample:
    """The content of a scene of N objects and M contact points.

    Attributes:
        arrays: (N, F, ...) by the names of `ARRAYS`.
        pairs: (M, 2) indices of the objects in contact; other indices are the floor or an object
            that is never visible.
        frames: (M,) the first frame of the video at or after each contact.
        contact_positions: (M, 3).
        normals: (M, 3).
    """

    objects: tuple[SceneObject, ...]
    image_size: tuple[int, int]
    arrays: dict[str, np.ndarray]
    pairs: np.ndarray
    frames: np.ndarray
    contact_positions: np.ndarray
    normals: np.ndarray


def read_folder(folder: Path) -> MoviExample:
    """Read Kubric's format, a folder with metadata.json and events.json.

    Raises:
        RecordError: A file is missing, damaged or does not have the published layout.
    """
    where, where_events = str(folder / "metadata.json"), str(folder / "events.json")
    metadata, events = load_json(where), load_json(where_events)
    video = get_field(metadata, "metadata", dict, where)
    frames, rate = (get_field(video, key, int, where) for key in ("num_frames", "frame_rate"))
    _check_clock(frames, rate, where)
    instances = get_field(metadata, "instances", list, where)
    contacts = get_field(events, "collisions", list, where_events)
    objects = []
    for instance in instances:
        look = {name: get_field(instance, key, str, where) for name, key in KUBRIC_KEYS.items()}
        for name, word in look.items():
            check_choice(word, APPEARANCE[name], f"{where}: {name}")
        objects.append(SceneObject(**look))

    def contact_array(key: str, *tail: int) -> np.ndarray:
        kind = list if tail else float
        values = [get_field(contact, key, kind, where_events) for contact in contacts]
        return finite_array(values, (len(contacts), *tail), f"{where_events}: {key}")

    size = finite_array(get_field(video, "resolution", list, where), (2,), f"{where}: resolution")
    return MoviExample(
        objects=tuple(objects),
        image_size=(int(size[0]), int(size[1])),
        arrays={
            key: finite_array(
                [get_field(instance, key, list, where) for instance in instances],
                (len(instances), FRAMES, *tail),
                f"{where}: {key}",
            )
            for key, tail in ARRAYS.items()
        },
        pairs=contact_array("instances", 2).astype(int),
        frames=np.maximum(np.ceil(contact_array("frame")).astype(int) - 1, 0),
        contact_positions=contact_array("position", 3),
        normals=contact_array("contact_normal", 3),
    )


def _check_clock(frames: int, rate: int, where: str) -> None:
    if (frames, rate) != (FRAMES, FPS):
        raise RecordError(f"{where} has {frames} frames at {rate} fps, expected {FRAMES} at {FPS}")


def read_record(path: Path) -> MoviExample:
    """Read the format of TensorFlow Datasets; `path` is a shard's path and a record's number.

    Raises:
        RecordError: The record is damaged or does not have the published layout.
    """
    features = read_example(path.parent, int(path.name))
    where = f"{path.parent}: record {int(path.name)}"

    def values(name: str) -> list[bytes] | np.ndarray:
        return feature_values(get_field(features, name, object, where))

    def array(name: str, *shape: int) -> np.ndarray:
        flat, size = values(name), int(np.prod(shape))
        if len(flat) != size:
            raise RecordError(f"{where} has {len(flat)} values of {name!r}, expected {size}")
        return finite_array(np.reshape(flat, shape), shape, f"{where}: {name}")

    frames, count, width, height = (
        int(array(f"metadata/{key}")) for key in ("num_frames", "num_instances", "width", "height")
    )
    _check_clock(frames, FPS, where)
    looks = {}
    for name, words in APPEARANCE.items():
        numbers = array(f"instances/{name}_label", count).astype(int)
        if not ((numbers >= 0) & (numbers < len(words))).all():
            raise RecordError(
                f"{where}: {name}_label has {numbers.max()}, expected 0 to {len(words) - 1}"
            )
        looks[name] = [words[n] for n in numbers]
    rows = len(values("events/collisions/frame"))
    return MoviExample(
        objects=tuple(
            SceneObject(**{name: words[k] for name, words in looks.items()}) for k in range(count)
        ),
        image_size=(width, height),
        arrays={k: array(f"instances/{k}", count, FRAMES, *tail) for k, tail in ARRAYS.items()},
        pairs=array("events/collisions/instances", rows, 2).astype(int),
        frames=array("events/collisions/frame", rows).astype(int),
        contact_positions=array("events/collisions/position", rows, 3),
        normals=array("events/collisions/contact_normal", rows, 3),
    )
