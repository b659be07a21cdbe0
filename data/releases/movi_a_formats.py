"""The two formats of a MoVi-A scene, both read into the same arrays.

The physics starts at scene frame 0 and the rendering at scene frame 1: frame i of the video, and of
every array, is scene frame i + 1. The time of a contact counts scene frames from 0. It is a float
in Kubric's format; TensorFlow Datasets truncates it, so that the next frame is the first that is
certainly at or after the contact.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data.records import SceneObject
from data.releases.tfrecord import read_example
from data.releases.validation import RecordError, check_choice, finite_array, get_field

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
    metadata, events = (_load_json(folder / name) for name in ("metadata.json", "events.json"))
    where, where_events = str(folder / "metadata.json"), str(folder / "events.json")
    video = get_field(metadata, "metadata", dict, where)
    _check_clock(
        *(get_field(video, key, int, where) for key in ("num_frames", "frame_rate")), where
    )
    size = finite_array(get_field(video, "resolution", list, where), (2,), f"{where}: resolution")
    instances = get_field(metadata, "instances", list, where)
    contacts = get_field(events, "collisions", list, where_events)

    def attributes(instance: dict[str, Any]) -> SceneObject:
        return SceneObject(
            **{
                name: check_choice(get_field(instance, key, str, where), APPEARANCE[name], where)
                for name, key in KUBRIC_KEYS.items()
            }
        )

    def array(key: str, *tail: int) -> np.ndarray:
        values = [get_field(instance, key, list, where) for instance in instances]
        return finite_array(values, (len(instances), FRAMES, *tail), f"{where}: {key}")

    def contact_array(key: str, *tail: int) -> np.ndarray:
        kind = list if tail else float
        values = [get_field(contact, key, kind, where_events) for contact in contacts]
        return finite_array(values, (len(contacts), *tail), f"{where_events}: {key}")

    return MoviExample(
        objects=tuple(map(attributes, instances)),
        image_size=(int(size[0]), int(size[1])),
        arrays={key: array(key, *tail) for key, tail in ARRAYS.items()},
        pairs=contact_array("instances", 2).astype(int),
        frames=np.maximum(np.ceil(contact_array("frame")).astype(int) - 1, 0),
        contact_positions=contact_array("position", 3),
        normals=contact_array("contact_normal", 3),
    )


def _load_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing", "missing-file") from error
    except ValueError as error:
        raise RecordError(f"{path} is cut off or not JSON: {error}", "damaged-file") from error


def _check_clock(frames: int, rate: int, where: str) -> None:
    if (frames, rate) != (FRAMES, FPS):
        raise RecordError(f"{where} has {frames} frames at {rate} fps, expected {FRAMES} at {FPS}")


def read_record(path: Path) -> MoviExample:
    """Read the format of TensorFlow Datasets; `path` is a shard's path and a record's number.

    Raises:
        RecordError: The record is damaged or does not have the published layout.
    """
    video = [f"metadata/{key}" for key in ("num_frames", "num_instances", "width", "height")]
    labels = {f"instances/{name}_label": words for name, words in APPEARANCE.items()}
    contacts = ("instances", "frame", "position", "contact_normal")
    names = [
        *video,
        *labels,
        *(f"instances/{key}" for key in ARRAYS),
        *(f"events/collisions/{key}" for key in contacts),
    ]
    features = read_example(path.parent, int(path.name), names)
    where = f"{path.parent}: record {int(path.name)}"
    if missing := [name for name in names if name not in features]:
        raise RecordError(f"{where} has no feature {missing[0]!r}, which MoVi-A's release has")

    def array(name: str, *shape: int) -> np.ndarray:
        if len(features[name]) != np.prod(shape, dtype=int):
            raise RecordError(
                f"{where} has {len(features[name])} values of {name!r}, expected "
                f"{np.prod(shape, dtype=int)}"
            )
        return finite_array(np.reshape(features[name], shape), shape, f"{where}: {name}")

    frames, count, width, height = (int(array(name)) for name in video)
    _check_clock(frames, FPS, where)
    rows = len(features["events/collisions/frame"])
    columns = []
    for name, words in labels.items():
        numbers = array(name, count).astype(int)
        if not ((numbers >= 0) & (numbers < len(words))).all():
            raise RecordError(f"{where}: {name} is {numbers.max()}, expected 0 to {len(words) - 1}")
        columns.append([words[n] for n in numbers])
    return MoviExample(
        objects=tuple(
            SceneObject(**dict(zip(APPEARANCE, words, strict=True)))
            for words in zip(*columns, strict=True)
        ),
        image_size=(width, height),
        arrays={k: array(f"instances/{k}", count, FRAMES, *tail) for k, tail in ARRAYS.items()},
        pairs=array("events/collisions/instances", rows, 2).astype(int),
        frames=array("events/collisions/frame", rows).astype(int),
        contact_positions=array("events/collisions/position", rows, 3),
        normals=array("events/collisions/contact_normal", rows, 3),
    )
