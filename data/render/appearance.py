"""Appearance of objects: colours, meshes and textures."""

from __future__ import annotations

from itertools import product

import numpy as np

from dynapix.data.sim.shapes import CUBE_HALF, RADIUS

RGB = {
    "gray": (112, 112, 112),
    "red": (186, 38, 38),
    "blue": (38, 72, 204),
    "green": (34, 136, 34),
    "brown": (122, 66, 22),
    "cyan": (38, 196, 196),
    "purple": (132, 38, 186),
    "yellow": (250, 230, 48),
}
"""CLEVRER's colours; green and brown are darker so that small objects differ more."""

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Vertices (V, 3), normals (V, 3), texture coordinates (V, 2) and triangles (T, 3)."""
SEGMENTS = 48
"""Number of segments around the z axis."""


def mesh(shape: str) -> Mesh:
    """Return the surface of an object of scale 1."""
    if shape == "cube":
        return box_mesh(np.full(3, CUBE_HALF))
    if shape == "sphere":
        angle = np.linspace(0, np.pi, SEGMENTS // 2 + 1)
        normals = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        return _revolve(RADIUS * normals, normals, angle / np.pi)
    # For a hard edge, a rim point occurs twice: with the normal of the cap and that of the side.
    points = RADIUS * np.array([[0, 1], [1, 1], [1, 1], [1, -1], [1, -1], [0, -1]], dtype=float)
    normals = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [0, -1], [0, -1]], dtype=float)
    return _revolve(points, normals, np.array([0.05, 0.2, 0.25, 0.75, 0.8, 0.95]))


def _revolve(points: np.ndarray, normals: np.ndarray, down: np.ndarray) -> Mesh:
    """Rotate a profile of (radius, height) points about the z axis; `down` is their texture v."""
    turns = np.linspace(0, 2 * np.pi, SEGMENTS + 1)

    def spin(profile: np.ndarray) -> np.ndarray:
        radius, height = profile.T[..., None]
        around = np.broadcast_arrays(radius * np.cos(turns), radius * np.sin(turns), height)
        return np.stack(around, axis=-1).reshape(-1, 3)

    uvs = np.stack(np.broadcast_arrays(turns[None] / (2 * np.pi), down[:, None]), axis=-1)
    row, column = np.meshgrid(np.arange(len(points) - 1), np.arange(SEGMENTS), indexing="ij")
    a = (row * (SEGMENTS + 1) + column).ravel()
    b = a + SEGMENTS + 1
    triangles = np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)])
    return spin(points), spin(normals), uvs.reshape(-1, 2), triangles


def box_mesh(half: np.ndarray) -> Mesh:
    """Return the surface of a box, whose edges have the halves (3,)."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    vertices, normals = [], []
    for axis, side in product(range(3), (-1.0, 1.0)):
        face = np.insert(corners, axis, side, axis=1)
        is_outward = np.cross(face[1] - face[0], face[2] - face[1])[axis] * side > 0
        vertices.append(face if is_outward else face[::-1])
        normals.append(np.tile(np.insert(np.zeros(2), axis, side), (4, 1)))
    triangles = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    uvs = np.tile((corners + 1) / 2, (6, 1))
    return half * np.concatenate(vertices), np.concatenate(normals), uvs, triangles.reshape(-1, 3)


def texture(material: str) -> np.ndarray:
    """Return a (64, 64, 3) uint8 texture that multiplies an object's colour: for metal, it imitates
    the reflection of a bright sky over a dark horizon; for rubber, it is uniform."""
    if material == "rubber":
        return np.full((64, 64, 3), 215, dtype=np.uint8)
    across, down = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64))
    sky = np.where(down < 0.5, 1.0 - 0.5 * down, 0.15 + 1.1 * (down - 0.5))
    reflection = sky * (1 + 0.25 * np.cos(4 * np.pi * across))
    return (255 * np.clip(reflection, 0.1, 1)).astype(np.uint8)[..., None].repeat(3, 2)
