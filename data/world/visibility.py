"""Which objects a camera sees, and how much of each."""

from __future__ import annotations

import numpy as np

from data.records import SceneObject
from data.world.camera import Camera
from data.world.shapes import BOUNDING_RADIUS, intersect_rays

STRIDE = 2
"""Step in px between the rays that measure visibility. With one ray for every four pixels, the
fraction of a visible object is within 2% of the one from a ray for each pixel."""


def compute_visibility(
    objects: tuple[SceneObject, ...],
    positions: np.ndarray,
    quaternions: np.ndarray,
    camera: Camera,
) -> tuple[np.ndarray, np.ndarray]:
    """Measure which objects are in view, and their visible fractions, by ray casting.

    Args:
        positions: (F, N, 3).
        quaternions: (F, N, 4) in x y z w order.

    Returns:
        in_view (F, N) bool and visible_fraction (F, N) in [0, 1], as `Scene` defines them.
    """
    centre, depth = camera.project(positions)
    bound = np.array([BOUNDING_RADIUS[o.shape] for o in objects])
    in_front = depth > bound + 0.05
    # The outline of an off-axis sphere is longer than focal * r / depth: 1.3 covers the view.
    reach = np.where(in_front, 1.3 * camera.focal * bound / np.maximum(depth, 1e-3), 0.0)
    size = np.array([camera.width, camera.height])
    inside = in_front & (
        (centre - reach[..., None] >= 0) & (centre + reach[..., None] <= size)
    ).all(-1)
    outside = ~in_front | (
        (centre + reach[..., None] < 0) | (centre - reach[..., None] > size)
    ).any(-1)
    hides = _may_hide(positions - np.asarray(camera.eye), bound)
    hides &= ~outside[:, :, None] & ~outside[:, None, :]

    in_view = inside.copy()
    fraction = inside.astype(np.float64)
    eye = np.asarray(camera.eye)
    for f, i in np.argwhere(~outside & (~inside | hides.any(-1))):
        columns, rows = _pixels_around(centre[f, i], reach[f, i], camera)
        rays = camera.rays(columns, rows)
        own = intersect_rays(objects[i].shape, positions[f, i], quaternions[f, i], eye, rays)
        covered = np.isfinite(own)
        visible = covered.copy()
        for j in np.flatnonzero(hides[f, i]):
            other = intersect_rays(objects[j].shape, positions[f, j], quaternions[f, j], eye, rays)
            visible &= ~(other < own)
        in_view[f, i] = covered.any()
        fraction[f, i] = visible.sum() / covered.sum() if covered.any() else 0.0
    return in_view, fraction


def _may_hide(centres: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """(F, N, N) whether object j may hide a part of object i.

    This requires that the view cones of their bounding spheres overlap and j is not entirely
    behind i.

    Args:
        centres: (F, N, 3) positions relative to the camera.
        bound: (N,) radii of the bounding spheres.
    """
    distance = np.linalg.norm(centres, axis=-1)
    toward = centres / distance[..., None]
    cone = np.arcsin(np.minimum(bound / distance, 1))
    angle = np.arccos(np.clip(np.einsum("fic,fjc->fij", toward, toward), -1, 1))
    overlap = angle < cone[:, :, None] + cone[:, None, :]
    behind = (distance - bound)[:, None, :] > (distance + bound)[:, :, None]
    return overlap & ~behind & ~np.eye(len(bound), dtype=bool)


def _pixels_around(
    centre: np.ndarray, reach: float, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    left, top = np.maximum(np.floor(centre - reach), 0).astype(int)
    right = min(int(centre[0] + reach) + 1, camera.width)
    bottom = min(int(centre[1] + reach) + 1, camera.height)
    columns, rows = np.meshgrid(np.arange(left, right, STRIDE), np.arange(top, bottom, STRIDE))
    return columns.ravel().astype(float), rows.ravel().astype(float)
