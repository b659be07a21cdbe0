"""Sizes of the objects, and intersections of rays with them."""

from __future__ import annotations

from functools import reduce

import numpy as np

RADIUS = 0.2
"""Radius of spheres and cylinders, and half the height of cylinders, simulator units. All objects
of one shape have the same size, as in CLEVRER."""
CUBE_HALF = 0.18
"""Half of a cube's edge, simulator units."""
BOUNDING_RADIUS = {"sphere": RADIUS, "cylinder": RADIUS * 2**0.5, "cube": CUBE_HALF * 3**0.5}
"""Radius of each shape's bounding sphere, simulator units."""


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation matrix of a unit quaternion in x y z w order."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def intersect_rays(
    shape: str, position: np.ndarray, quaternion: np.ndarray, eye: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """Return each ray's parameter at its first intersection with an object, (P,); inf for none."""
    to_local = rotation_matrix(quaternion)
    origin = (eye - position) @ to_local
    direction = rays @ to_local
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape == "sphere":
            return _solve_quadric(origin, direction, 3)
        if shape == "cube":
            low, high = _slab(origin, direction, CUBE_HALF)
            low, high = reduce(np.maximum, low.T), reduce(np.minimum, high.T)
            return np.where((low <= high) & (low > 0), low, np.inf)
        side = _solve_quadric(origin, direction, 2)
        on_side = np.abs(origin[2] + side * direction[:, 2]) <= RADIUS
        side = np.where(on_side, side, np.inf)
        cap = _slab(origin[2:], direction[:, 2:], RADIUS)[0][:, 0]
        across = origin[:2] + cap[:, None] * direction[:, :2]
        on_cap = _squares(across) <= RADIUS**2
        return np.minimum(side, np.where(on_cap & (cap > 0), cap, np.inf))


def _solve_quadric(origin: np.ndarray, direction: np.ndarray, axes: int) -> np.ndarray:
    """Return the first intersection with a sphere (3 axes) or an infinite z cylinder (2 axes)."""
    o, d = origin[:axes], direction[:, :axes]
    a = _squares(d)
    b = d @ o
    c = o @ o - RADIUS**2
    discriminant = b * b - a * c
    t = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
    return np.where((discriminant > 0) & (t > 0), t, np.inf)


def _squares(vectors: np.ndarray) -> np.ndarray:
    """Return squared lengths (P,), summed by column because numpy is slow along a short axis."""
    return reduce(np.add, (vectors**2).T)


def _slab(origin: np.ndarray, direction: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ray parameters where rays enter and leave the region |x| <= half of each axis."""
    first, second = (-half - origin) / direction, (half - origin) / direction
    return np.minimum(first, second), np.maximum(first, second)
