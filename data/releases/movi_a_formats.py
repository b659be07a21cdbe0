"""The two formats of a MoVi-A scene, both read into the same arrays.

The physics starts at scene frame 0 and the rendering at scene frame 1: frame i of the video, and of
every array, is scene frame i + 1. The time of a contact counts scene frames from 0. It is a float
in Kubric's format; TensorFlow Datasets truncates it, so that the next frame is the first that is
certainly at or after the contact.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from data.records import SceneObject
from data.releases.tfrecord import feature_values, read_example
from data.releases.validation import Layout, RecordError, finite_array, read_json

FRAMES, FPS = 24, 12
SHAPES = ("cube", "cylinder", "sphere")
MATERIALS = ("metal", "rubber")
COLORS = ("blue", "brown", "cyan", "gray", "green", "purple", "red", "yellow")
SIZES = ("small", "large")
APPEARANCE = {"shape": SHAPES, "material": MATERIALS, "color": COLORS, "size": SIZES}
"""Words of each attribute, in the order in which TensorFlow Datasets numbers them."""
STATES = {
    "positions": (FRAMES, 3),
    "quaternions": (FRAMES, 4),
    "velocities": (FRAMES, 3),
    "angular_velocities": (FRAMES, 3),
    "image_positions": (FRAMES, 2),
    "visibility": (FRAMES,),
}
"""Shape of each array per object."""
CONTACTS = {"instances": (2,), "frame": (), "position": (3,), "contact_normal": (3,)}
"""Shape of each array per contact point."""


def _check_float(value: object) -> object:
    if not isinstance(value, float):
        raise ValueError(f"{value!r} is truncated, expected a float")
    return value


class Instance(Layout):
    shape: Literal[SHAPES]
    material: Literal[MATERIALS]
    color: Literal[COLORS] = Field(alias="color_label")
    size: Literal[SIZES] = Field(alias="size_label")
    positions: list
    quaternions: list
    velocities: list
    angular_velocities: list
    image_positions: list
    visibility: list


class Video(Layout):
    resolution: tuple[int, int]
    num_frames: Literal[FRAMES]
    frame_rate: Literal[FPS]


class Metadata(Layout):
    metadata: Video
    instances: list[Instance]


class Contact(Layout):
    instances: list
    frame: Annotated[float, BeforeValidator(_check_float)]
    position: list
    contact_normal: list


class Events(Layout):
    collisions: list[Contact]


@dataclass(frozen=True)
class MoviExample:
    """The content of a scene.

    Attributes:
        states: Arrays by the names of `STATES`, each (objects, ...).
        contacts: Arrays by the names of `CONTACTS`, each (contact points, ...). `instances` are
            indices of the objects in contact; other indices are the floor or an object that is
            never visible. `frame` is the first frame of the video at or after the contact.
    """

    objects: tuple[SceneObject, ...]
    image_size: tuple[int, int]
    states: dict[str, np.ndarray]
    contacts: dict[str, np.ndarray]


def read_folder(folder: Path) -> MoviExample:
    """Read Kubric's format, a folder with metadata.json and events.json.

    Raises:
        RecordError: A file is missing, damaged or does not have the published layout.
    """
    metadata = read_json(folder / "metadata.json", Metadata)
    events = read_json(folder / "events.json", Events)

    def array(rows: list[Instance] | list[Contact], key: str, *shape: int) -> np.ndarray:
        values = [getattr(row, key) for row in rows]
        return finite_array(values, (len(rows), *shape), f"{folder}: {key}")

    contacts = {key: array(events.collisions, key, *shape) for key, shape in CONTACTS.items()}
    contacts["frame"] = np.maximum(np.ceil(contacts["frame"]) - 1, 0)
    return MoviExample(
        tuple(SceneObject(i.shape, i.material, i.color, i.size) for i in metadata.instances),
        metadata.metadata.resolution,
        {key: array(metadata.instances, key, *shape) for key, shape in STATES.items()},
        contacts,
    )


def read_record(path: Path) -> MoviExample:
    """Read the format of TensorFlow Datasets; `path` is a shard's path and a record's number.

    Raises:
        RecordError: The record is damaged or does not have the published layout.
    """
    features = read_example(path.parent, int(path.name))
    where = f"{path.parent}: record {int(path.name)}"

    def array(name: str, *shape: int) -> np.ndarray:
        if name not in features:
            raise RecordError(f"{where} has no feature {name!r}, which the published layout has")
        return finite_array(feature_values(features[name]), shape, f"{where}: {name}")

    frames, count, width, height = (
        int(array(f"metadata/{key}")) for key in ("num_frames", "num_instances", "width", "height")
    )
    if frames != FRAMES:
        raise RecordError(f"{where} has {frames} frames, expected {FRAMES}")
    looks = []
    for name, words in APPEARANCE.items():
        numbers = array(f"instances/{name}_label", count).astype(int)
        if not set(numbers) <= set(range(len(words))):
            raise RecordError(f"{where}: {name}_label is {numbers}, expected 0 to {len(words) - 1}")
        looks.append([words[n] for n in numbers])
    points = len(array("events/collisions/frame", -1))
    return MoviExample(
        tuple(map(SceneObject, *looks)),
        (width, height),
        {key: array(f"instances/{key}", count, *shape) for key, shape in STATES.items()},
        {key: array(f"events/collisions/{key}", points, *shape) for key, shape in CONTACTS.items()},
    )
