"""Writes small files in the two formats of MoVi-A's release."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from dynapix.data.sources.tfrecord import example_class
from tests.data.sources.pictures import picture, png

MOVI_COLORS = ["blue", "brown", "cyan", "gray", "green", "purple", "red", "yellow"]
ARRAYS = (
    "positions", "quaternions", "velocities", "angular_velocities", "image_positions", "visibility",
    "bboxes_3d",
)  # fmt: skip
Contacts = list[tuple[float, int, int, float, float]]


def movi_example(contacts: Contacts | None = None) -> dict:
    """Three falling objects, the last of which is never visible.

    Args:
        contacts: Tuples of a frame, two instances, a height, and the z component of the normal.
    """
    s = np.arange(1, 25) / 12
    x = np.stack([np.zeros(24), 1 + s, -1 - s])
    z = np.stack([5 - 0.5 * 9.81 * s**2] * 3)
    half = np.stack([s, s, s]) / 2
    positions = np.stack([x, 0 * x, z], -1)
    # Boxes of widths 1.4, 0.6 and 1, turned about z by 0.8 rad.
    turn = [[np.cos(0.8), np.sin(0.8), 0], [-np.sin(0.8), np.cos(0.8), 0], [0, 0, 1]]
    corners = np.array([*product((-0.5, 0.5), repeat=3)]) @ turn
    return {
        "appearances": [
            ("cube", "large", "metal", "red"),
            ("sphere", "small", "rubber", "cyan"),
            ("cylinder", "small", "metal", "red"),
        ],
        "positions": positions,
        "quaternions": np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], -1),
        "velocities": np.stack([np.sign(x), 0 * x, np.stack([-9.81 * s] * 3)], -1),
        "angular_velocities": np.stack([0 * x, 0 * x, 0 * x + 1], -1),
        "image_positions": np.stack([0.5 + x / 20, 0.9 - z / 10], -1),
        "visibility": np.stack([np.full(24, 90), np.full(24, 30), np.arange(24) * 0]),
        "bboxes_3d": positions[:, :, None] + np.multiply.outer([1.4, 0.6, 1.0], corners)[:, None],
        "contacts": contacts or [],
    }


def write_movi_folder(folder: Path, example: dict) -> Path:
    folder.mkdir(parents=True)
    instances = [
        {
            "size": 1.4, "color": [0.5, 0.1, 0.1],
            "shape": shape, "size_label": size, "material": material, "color_label": color,
            **{key: example[key][k].tolist() for key in ARRAYS},
        }
        for k, (shape, size, material, color) in enumerate(example["appearances"])
    ]  # fmt: skip
    metadata = {
        "metadata": {"resolution": [256, 256], "frame_rate": 12, "num_frames": 24},
        "camera": {"focal_length": 35.0},
        "instances": instances,
    }
    collisions = [
        {
            "instances": [one, two], "frame": frame, "position": [0.0, 0.0, height],
            "contact_normal": [(1 - up**2) ** 0.5, 0.0, up],
        }
        for frame, one, two, height, up in example["contacts"]
    ]  # fmt: skip
    (folder / "metadata.json").write_text(json.dumps(metadata))
    (folder / "events.json").write_text(json.dumps({"collisions": collisions}))
    for f in range(24):
        seen = picture(f, (256, 256)).convert("RGBA")
        seen.putalpha(128)
        (folder / f"rgba_{f:05d}.png").write_bytes(png(seen))
    return folder / "metadata.json"


def movi_features(example: dict) -> dict[str, Any]:
    """Return the example's features as TensorFlow Datasets flattens them, by name."""
    contacts = example["contacts"]
    shapes, sizes, materials, colors = zip(*example["appearances"], strict=True)
    return {
        "metadata/width": [256],
        "metadata/height": [256],
        "metadata/num_frames": [24],
        "metadata/num_instances": [len(example["appearances"])],
        **{f"instances/{key}": example[key].ravel().tolist() for key in ARRAYS},
        "instances/shape_label": [["cube", "cylinder", "sphere"].index(s) for s in shapes],
        "instances/size_label": [["small", "large"].index(s) for s in sizes],
        "instances/material_label": [["metal", "rubber"].index(m) for m in materials],
        "instances/color_label": [MOVI_COLORS.index(c) for c in colors],
        "events/collisions/frame": [int(c[0]) for c in contacts],
        "events/collisions/instances": [i % 65536 for c in contacts for i in c[1:3]],
        "events/collisions/position": [v for c in contacts for v in (0.0, 0.0, c[3])],
        "events/collisions/contact_normal": [
            v for c in contacts for v in ((1 - c[4] ** 2) ** 0.5, 0.0, c[4])
        ],
        "video": [png(picture(f, (256, 256))) for f in range(24)],
        "forward_flow": [-1, 70_000] * 50,
    }


def write_tfrecord(path: Path, examples: list[dict[str, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = {bytes: "bytes_list", float: "float_list"}
    with open(path, "wb") as file:
        for features in examples:
            message = example_class()()
            for name, values in features.items():
                entry = message.features.feature.add(key=name)
                kind = kinds.get(type(values[0]) if values else int, "int64_list")
                getattr(entry.value, kind).value.extend(values)
            data = message.SerializeToString()
            file.write(len(data).to_bytes(8, "little") + b"CRC." + data + b"CRC.")
    return path
