"""Which objects lie in a camera's image, and which fraction of each is visible."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from data.records import Scene, SceneObject
from data.world.camera import Camera, pixel_rays
from data.world.parts import Box
from data.world.shapes import BOUNDING_RADIUS, half_height, intersect_object, rotation_matrix

MIN_VISIBLE = 0.05
"""Visible fraction up to which an object in view counts as hidden."""
STRIDE = 2 / 105
"""Step between the rays that measure visibility, as a fraction of the length in px of a simulator
unit in the middle of the image. In the world of CLEVRER, it is 2 px: one ray for every 2 x 2 pixels
gives visible fractions within 2% of those from one ray per pixel."""


def is_hidden(scene: Scene) -> np.ndarray:
    """Return whether other objects or parts hide each object (F, N). A fraction that the simulator
    does not record (NaN) counts as visible."""
    return scene.visible_fraction <= MIN_VISIBLE


def compute_visibility(
    objects: tuple[SceneObject, ...],
    positions: np.ndarray,
    quaternions: np.ndarray,
    camera: Camera,
    scales: Sequence[float] | None = None,
    parts: tuple[Box, ...] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Determine by ray casting which objects are in view, and their visible fractions.

    Args:
        positions: (F, N, 3).
        quaternions: (F, N, 4) in x y z w order.
        scales: (N,) sizes of the objects; 1 by default.
        parts: Boxes of the world that may hide objects.

    Returns:
        in_view (F, N) bool and visible_fraction (F, N) in [0, 1], as `Scene` defines them. An
        object that others hide completely is in view.
    """
    scales = scales or [1.0] * len(objects)
    centre, depth = camera.project(positions)
    radius = np.array([BOUNDING_RADIUS[o.shape] * s for o, s in zip(objects, scales, strict=True)])
    in_front = depth > radius + 0.05
    # A square that contains the object in the image; 1.3 because off-axis spheres look larger.
    half_side = np.where(in_front, 1.3 * camera.focal * radius / np.maximum(depth, 1e-3), 0.0)
    low, high = centre - half_side[..., None], centre + half_side[..., None]
    size = np.array([camera.width, camera.height])
    stride = max(1, round(STRIDE * camera.magnification))
    inside = ((low >= 0) & (high <= size)).all(-1)
    # A ray meets the sphere inscribed in the object: one passes by its centre within a stride.
    inscribed = np.array([half_height(o.shape, s) for o, s in zip(objects, scales, strict=True)])
    is_met = ((centre >= 0) & (centre < size)).all(-1)
    is_met &= camera.focal * inscribed > 2 * stride * depth
    # The image contains a part of the object, without which no fraction of it is visible.
    certain = in_front & (inside | is_met)
    outside = ~in_front | ((high < 0) | (low > size)).any(-1)
    eye = np.asarray(camera.eye)
    hides = _may_hide(positions - eye, radius)
    hides &= ~outside[:, :, None] & ~outside[:, None, :]
    behind_part = np.zeros_like(certain)
    for box in parts:
        behind_part |= _box_may_hide(box, low, high, positions, radius, camera)
    behind = hides.any(-1) | behind_part

    in_view = certain.copy()
    fraction = certain.astype(np.float64)

    def intersect(f: int, k: int, rays: np.ndarray) -> np.ndarray:
        shape, scale = objects[k].shape, scales[k]
        return intersect_object(shape, scale, positions[f, k], quaternions[f, k], eye, rays)

    # Rays are needed only for objects behind something, and for those that may be out of view.
    for f, i in np.argwhere(~outside & (~certain | behind)):
        window = _pixels_around(low[f, i], high[f, i], camera, stride)
        hidden_by = np.flatnonzero(hides[f, i])
        is_behind_part = False
        if behind_part[f, i]:
            part_distances = _part_distances(camera, parts)[window].reshape(-1)
            # Distances are depths, since rays advance by 1 along the optical axis.
            is_behind_part = part_distances.min() < depth[f, i] + radius[i]
            if certain[f, i] and part_distances.max() < depth[f, i] - radius[i]:
                # Parts hide the object completely.
                fraction[f, i] = 0.0
                continue
            if certain[f, i] and not is_behind_part and not len(hidden_by):
                continue
        rays = pixel_rays(camera)[window].reshape(-1, 3)
        own = intersect(f, i, rays)
        covered = np.isfinite(own)
        in_view[f, i] = covered.any()
        if not covered.any():
            fraction[f, i] = 0.0
            continue
        rays, own = rays[covered], own[covered]
        visible = np.ones(len(own), dtype=bool)
        for j in hidden_by:
            visible &= ~(intersect(f, j, rays) < own)
        if is_behind_part:
            visible &= ~(part_distances[covered] < own)
        fraction[f, i] = visible.sum() / len(own)
    return in_view, fraction


def _may_hide(centres: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return whether object j may hide a part of object i, (F, N, N) by frame, i and j.

    This requires that their bounding spheres overlap in the image, and that they intersect or j is
    in front of i. The radical plane of disjoint spheres separates them, and the camera is on the
    side of the sphere of which its power is less. Every ray meets this sphere first.

    Args:
        centres: (F, N, 3) positions relative to the camera.
        radius: (N,) radii of the bounding spheres.
    """
    distance = np.linalg.norm(centres, axis=-1)
    toward = centres / distance[..., None]
    cone = np.arcsin(np.minimum(radius / distance, 1))
    angle = np.arccos(np.clip(np.einsum("fic,fjc->fij", toward, toward), -1, 1))
    overlap = angle < cone[:, :, None] + cone[:, None, :]
    power = distance**2 - radius**2
    in_front = power[:, None, :] < power[:, :, None]
    apart = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=-1)
    intersect = apart < np.add.outer(radius, radius)
    return overlap & (in_front | intersect) & ~np.eye(len(radius), dtype=bool)


def _box_may_hide(
    box: Box,
    low: np.ndarray,
    high: np.ndarray,
    positions: np.ndarray,
    radius: np.ndarray,
    camera: Camera,
) -> np.ndarray:
    """Return whether a box may hide a part of each object, (F, N).

    This requires that the box and the object overlap in the image, and that no face of the box
    separates the object from it, on the side of the camera.

    Args:
        low, high: (F, N, 2) corners of squares that contain the objects in the image.
    """
    pixels, _ = camera.project(box.corners)
    overlap = ((low <= pixels.max(axis=0)) & (high >= pixels.min(axis=0))).all(-1)
    to_local = rotation_matrix(box.quaternion)
    eye = np.subtract(camera.eye, box.position) @ to_local
    side = np.where(eye > 0, 1, -1)
    outside = side * ((positions - box.position) @ to_local) - box.half
    faces_camera = side * eye > box.half
    return overlap & ~((outside >= radius[:, None]) & faces_camera).any(-1)


@lru_cache(maxsize=2)
def _part_distances(camera: Camera, parts: tuple[Box, ...]) -> np.ndarray:
    """Return the parameter of each pixel's ray at its first intersection with a part (H, W); inf
    for none."""
    rays = pixel_rays(camera)
    eye, flat = np.asarray(camera.eye), rays.reshape(-1, 3)
    first = [box.intersect(eye, flat) for box in parts]
    return np.min(first, axis=0).reshape(rays.shape[:2])


def _pixels_around(
    low: np.ndarray, high: np.ndarray, camera: Camera, stride: int
) -> tuple[slice, slice]:
    """Return every `stride`-th row and column of a square, as far as it is in the image."""
    left, top = (max(int(bound), 0) for bound in low)
    right, bottom = int(high[0]) + 1, int(high[1]) + 1
    rows = slice(top, min(bottom, camera.height), stride)
    return rows, slice(left, min(right, camera.width), stride)
