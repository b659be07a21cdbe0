"""Sizes of objects of scale 1, and intersections of rays with objects and boxes."""

from __future__ import annotations

from functools import reduce
from itertools import product

import numpy as np

from dynapix.conf.schema.world import RADIUS

CUBE_HALF = 0.18
"""Half of a cube's edge, simulator units."""
BOUNDING_RADIUS = {"sphere": RADIUS, "cylinder": RADIUS * 2**0.5, "cube": CUBE_HALF * 3**0.5}
"""Radius of each shape's bounding sphere, simulator units."""
CORNERS = np.array([*product((-1, 1), repeat=3)])
"""Corners (8, 3) of a cube with edges of length 2."""


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4) in x y z w order."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion), -1, 0)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.moveaxis(matrix, (0, 1), (-2, -1))


def half_height(shape: str, scale: float) -> float:
    """Return half the height of an upright object, simulator units."""
    return (CUBE_HALF if shape == "cube" else RADIUS) * scale


def intersect_object(
    shape: str, scale: float | np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Return the t at which each ray origin + t x direction first meets an object, (P,); inf if it
    does not. Rays start outside of the object.

    Args:
        scale: Size of the object, or (P,) sizes, one for each ray.
        origin: (3,) origin of all rays, or (P, 3) origins, in the object's own coordinates.
        direction: (P, 3).
    """
    if shape == "cube":
        return intersect_box(CUBE_HALF * np.asarray(scale)[..., None], origin, direction)
    radius = RADIUS * np.asarray(scale)
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape == "sphere":
            return _solve_quadric(origin, direction, 3, radius)
        side = _solve_quadric(origin, direction, 2, radius)
        on_side = np.abs(origin[..., 2] + side * direction[..., 2]) <= radius
        side = np.where(on_side, side, np.inf)
        cap = _slab(origin[..., 2], direction[..., 2], radius)[0]
        across = origin[..., :2] + cap[:, None] * direction[..., :2]
        on_cap = _dot(across, across) <= radius**2
        return np.minimum(side, np.where(on_cap & (cap > 0), cap, np.inf))


def intersect_box(half: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the t at which each ray first meets a box, (P,); see `intersect_object`.

    Args:
        half: (3,) halves of the edges; for cubes also (1,), or (P, 1) with one cube for each ray.
        origin, direction: As for `intersect_object`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = _slab(origin, direction, half)
        low, high = reduce(np.maximum, low.T), reduce(np.minimum, high.T)
        return np.where((low <= high) & (low > 0), low, np.inf)


def _solve_quadric(
    origin: np.ndarray, direction: np.ndarray, axes: int, radius: np.ndarray
) -> np.ndarray:
    """Return the first intersection with a sphere (3 axes) or an infinite z cylinder (2 axes) of
    one radius, or of (P,) radii."""
    o, d = origin[..., :axes], direction[..., :axes]
    a, b = _dot(d, d), _dot(d, o)
    c = _dot(o, o) - radius**2
    discriminant = b * b - a * c
    t = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
    return np.where((discriminant > 0) & (t > 0), t, np.inf)


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return dot products (...), summed by column because numpy is slow along a short axis."""
    return reduce(np.add, np.moveaxis(one * other, -1, 0))


def _slab(
    origin: np.ndarray, direction: np.ndarray, half: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ray parameters where rays enter and leave the region |x| <= half of each axis."""
    first, second = (-half - origin) / direction, (half - origin) / direction
    return np.minimum(first, second), np.maximum(first, second)
