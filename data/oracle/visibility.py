"""Which objects lie in a camera's image, and which fraction of each is visible."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np

from dynapix.data.records import Scene, SceneObject
from dynapix.data.sim.camera import Camera, pixel_rays
from dynapix.data.sim.parts import Box
from dynapix.data.sim.shapes import (
    BOUNDING_RADIUS,
    CORNERS,
    CUBE_HALF,
    half_height,
    intersect_object,
    rotation_matrix,
)

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
    low, high = _image_bounds(objects, positions, quaternions, scales, camera)
    size = np.array([camera.width, camera.height])
    stride = max(1, round(STRIDE * camera.magnification))

    in_front = depth > radius + 0.05
    outside = ~in_front | ((high < 0) | (low > size)).any(-1)
    # In each axis, a ray passes within a stride of a centre that is in the image. It meets the
    # sphere inscribed in the object if the radius in the image is above sqrt(2) strides. A factor
    # of 2 leaves a margin.
    inner = np.array([half_height(o.shape, s) for o, s in zip(objects, scales, strict=True)])
    is_met = ((centre >= 0) & (centre < size)).all(-1)
    is_met &= camera.focal * inner > 2 * stride * depth
    in_view = in_front & (is_met | ((low >= 0) & (high <= size)).all(-1))

    centres = positions - np.asarray(camera.eye)
    hides = _may_hide(centres, radius) & ~outside[:, :, None] & ~outside[:, None, :]
    hides &= ((low[:, :, None] < high[:, None]) & (high[:, :, None] > low[:, None])).all(-1)
    may_be_hidden = hides.any(-1)
    for box in parts:
        pixels, depths = camera.project(box.corners)
        overlap = ((low <= pixels.max(axis=0)) & (high >= pixels.min(axis=0))).all(-1)
        may_be_hidden |= overlap & (depths.min() < depth + radius)

    # Rays are needed only for objects that others may hide, and for those that may be out of view.
    pairs = [*map(tuple, np.argwhere(~outside & (may_be_hidden | ~in_view)).tolist())]
    # The grid of an object's rays has a point at the corner of a square around the object.
    half_side = 1.3 * camera.focal * radius / np.maximum(depth, 1e-3)
    point = np.maximum((centre - half_side[..., None]).astype(int), 0)
    windows = [_grid_window(low[pair], high[pair], point[pair], stride, camera) for pair in pairs]
    rays = [pixel_rays(camera)[window].reshape(-1, 3) for window in windows]

    intersect = partial(_intersect_objects, objects, np.array(scales), centres, quaternions)
    # Distances are depths, since rays advance by 1 along the optical axis.
    distances = intersect(pairs, rays)
    covered = [np.isfinite(each) for each in distances]
    own = [each[covers] for each, covers in zip(distances, covered, strict=True)]
    to_part = _part_distances(camera, parts)
    visible = [
        to_part[window].reshape(-1)[covers] >= each
        for window, covers, each in zip(windows, covered, own, strict=True)
    ]
    hiders = [(k, f, j) for k, (f, i) in enumerate(pairs) for j in np.flatnonzero(hides[f, i])]
    others = intersect([(f, j) for _, f, j in hiders], [rays[k][covered[k]] for k, _, _ in hiders])
    for (k, _, _), each in zip(hiders, others, strict=True):
        visible[k] &= each >= own[k]

    fraction = in_view.astype(np.float64)
    for (f, i), seen in zip(pairs, visible, strict=True):
        in_view[f, i] = len(seen) > 0
        fraction[f, i] = seen.mean() if len(seen) else 0.0
    return in_view, fraction


def _intersect_objects(
    objects: Sequence[SceneObject],
    scales: np.ndarray,
    centres: np.ndarray,
    quaternions: np.ndarray,
    pairs: Sequence[tuple[int, int]],
    rays: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Return the distances (P,) at which rays (P, 3) of the camera first meet an object; inf for
    those that do not.

    All rays towards objects of a shape are intersected at once: most sets of rays are so small that
    Python would take longer than numpy.

    Args:
        centres: (F, N, 3) positions of the objects relative to the camera.
        pairs: The frame and the object of each set of rays.
    """
    distances = [np.empty(0)] * len(pairs)
    for shape in sorted({each.shape for each in objects}):
        chosen = [k for k, (_, index) in enumerate(pairs) if objects[index].shape == shape]
        if not chosen:
            continue
        frames, indices = np.array([pairs[k] for k in chosen]).T
        counts = [len(rays[k]) for k in chosen]
        to_local = rotation_matrix(quaternions[frames, indices])
        origins = -np.einsum("ka,kab->kb", centres[frames, indices], to_local)
        directions = [rays[k] @ matrix for k, matrix in zip(chosen, to_local, strict=True)]
        first = intersect_object(
            shape,
            np.repeat(scales[indices], counts),
            np.repeat(origins, counts, axis=0),
            np.concatenate(directions),
        )
        for k, own in zip(chosen, np.split(first, np.cumsum(counts)[:-1]), strict=True):
            distances[k] = own
    return distances


def _may_hide(centres: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return whether object j may hide a part of object i if they overlap in the image, (F, N, N)
    by frame, i and j: their bounding spheres intersect, or j is in front of i.

    The power of a point is its squared distance from a sphere's centre minus the squared radius.
    The points with equal powers form a plane, which separates two disjoint spheres. The camera is
    on the side of the sphere with the lower power, so every ray meets this sphere first.

    Args:
        centres: (F, N, 3) positions relative to the camera.
        radius: (N,) radii of the bounding spheres.
    """
    power = (centres**2).sum(axis=-1) - radius**2
    apart = np.linalg.norm(centres[:, :, None] - centres[:, None, :], axis=-1)
    intersect = apart < np.add.outer(radius, radius)
    is_other = ~np.eye(len(radius), dtype=bool)
    return is_other & (intersect | (power[:, None, :] < power[:, :, None]))


@lru_cache(maxsize=16)
def _part_distances(camera: Camera, parts: tuple[Box, ...]) -> np.ndarray:
    """Return the parameter of each pixel's ray at its first intersection with a part (H, W); inf
    for none."""
    rays = pixel_rays(camera)
    eye, flat = np.asarray(camera.eye), rays.reshape(-1, 3)
    first = [np.full(len(flat), np.inf), *(box.intersect(eye, flat) for box in parts)]
    return np.min(first, axis=0).reshape(rays.shape[:2])


def _image_bounds(
    objects: Sequence[SceneObject],
    positions: np.ndarray,
    quaternions: np.ndarray,
    scales: Sequence[float],
    camera: Camera,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (F, N, 2), lowest and highest, of rectangles that contain the objects in
    the image. They are valid for objects whose bounding spheres are in front of the camera."""
    local = (positions - np.asarray(camera.eye)) @ camera.axes.T
    across, depth = local[..., :2], local[..., 2:]
    radius = [BOUNDING_RADIUS[o.shape] * s for o, s in zip(objects, scales, strict=True)]
    # Planes through the camera touch a bounding sphere at these angles to the optical axis.
    angle = np.arctan2(across, depth)
    spread = np.arcsin(np.minimum(np.array(radius)[:, None] / np.hypot(across, depth), 1))
    middle = np.array([camera.width / 2, camera.height / 2])
    low = middle + camera.focal * np.tan(angle - spread)
    high = middle + camera.focal * np.tan(angle + spread)
    for k in [k for k, each in enumerate(objects) if each.shape == "cube"]:
        turned = CORNERS @ np.swapaxes(rotation_matrix(quaternions[:, k]), -1, -2)
        pixels, _ = camera.project(positions[:, k, None] + CUBE_HALF * scales[k] * turned)
        low[:, k], high[:, k] = pixels.min(axis=-2), pixels.max(axis=-2)
    return low, high


def _grid_window(
    low: np.ndarray, high: np.ndarray, point: np.ndarray, stride: int, camera: Camera
) -> tuple[slice, slice]:
    """Return the rows and columns of a grid of pixels, of which `point` is one, as far as they are
    in a rectangle and in the image."""
    # The centre of pixel k is at k + 0.5.
    least = np.maximum(np.ceil(low - 0.5), 0).astype(int)
    first = least + (point - least) % stride
    last = np.minimum(np.floor(high - 0.5).astype(int) + 1, [camera.width, camera.height])
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    return slice(top, bottom, stride), slice(left, right, stride)
