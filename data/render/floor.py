"""Brightness of the floor: light that decreases with distance, and soft shadows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.sim.camera import Camera, pixel_rays
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.shapes import RADIUS

SHADOW_DEPTH = 0.55
"""Fraction of the light that a shadow removes at its centre."""
PENUMBRA = 0.06
"""Spread of the light's direction, by which the shadows of parts have soft edges."""

_SPREAD = 2 * (0.85 * RADIUS) ** 2
"""Twice the variance of a shadow's Gaussian profile at scale 1, squared simulator units."""
_REACH = 1.0
"""Half the side of the square in which a shadow is computed at scale 1, simulator units. At
distances d above 0.984 a shadow is below float32 precision:
SHADOW_DEPTH * exp(-d^2 / _SPREAD) < 2^-25."""


class Floor:
    """The floor and the background as one camera sees them."""

    def __init__(self, camera: Camera, world: WorldConfig) -> None:
        self._camera, self._light = camera, world.light.direction
        rays = pixel_rays(camera)
        is_sky = rays[..., 2] > -1e-3
        self._is_sky = np.nonzero(is_sky)
        reach = camera.eye[2] / np.where(is_sky, np.inf, -rays[..., 2])
        points = np.asarray(camera.eye)[:2] + reach[..., None] * rays[..., :2]
        distance = np.linalg.norm(points - np.array([0.3, 0.0]), axis=-1)
        self._lit = (1.12 / (1 + (distance / 7.5) ** 2)).astype(np.float32)
        self._lit *= self._part_shade(points, world)
        if camera.eye[1] == camera.aim[1] == 0:
            # x is equal along an image row; rounding errors along the row would make the shadows
            # of mirrored scenes differ.
            points[..., 0] = points[:, :1, 0]
        self._x, self._y = np.moveaxis(points, -1, 0).astype(np.float32).astype(float)

    def shade(
        self, positions: np.ndarray, scales: Sequence[float], boxes: np.ndarray
    ) -> np.ndarray:
        """Return the brightness of the floor with the shadows of objects at positions (N, 3), as
        (H, W) float32 factors for its colour. `scales` are the sizes (N,) of the objects, and
        `boxes` the bounding boxes (N, 4) of their shadows, from `shadow_boxes`."""
        shade = self._lit.copy()
        centres = self._shadow_centres(positions, scales).tolist()
        for (x, y), scale, (left, top, right, bottom) in zip(
            centres, scales, boxes.tolist(), strict=True
        ):
            if left < right and top < bottom:
                box = np.s_[top:bottom, left:right]
                squares = (self._y[box] - y) ** 2 + (self._x[box] - x) ** 2
                shade[box] *= 1 - SHADOW_DEPTH * np.exp(-squares / (_SPREAD * scale**2))
        return shade

    def paint(self, shade: np.ndarray, floor: float, background: float) -> np.ndarray:
        """Return one colour channel (H, W) of the floor, in `shade`, and of the background above
        the horizon; `floor` and `background` are its values, 0 to 255."""
        channel = shade * floor
        channel[self._is_sky] = background
        return channel

    def shadow_boxes(self, positions: np.ndarray, scales: Sequence[float]) -> np.ndarray:
        """Return the bounding boxes (..., N, 4) of the shadows of objects at positions (..., N, 3)
        of sizes (N,): left, top, right and bottom in pixels; right and bottom are exclusive."""
        ground = np.zeros(positions.shape)
        ground[..., :2] = self._shadow_centres(positions, scales)
        corners = _REACH * np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]])
        corners = np.asarray(scales)[:, None, None] * corners
        # `project` places a corner behind the camera far below the image; the box is then clipped.
        pixels, _ = self._camera.project(ground[..., None, :] + corners)
        size = self._camera.width, self._camera.height
        boxes = np.concatenate([pixels.min(axis=-2), pixels.max(axis=-2) + 1], axis=-1)
        return np.clip(boxes, 0, [*size, *size]).astype(int)

    def _shadow_centres(self, positions: np.ndarray, scales: Sequence[float]) -> np.ndarray:
        """Return the (..., N, 2) centres of the shadows of objects at (..., N, 3) positions."""
        slant = 0.5 * RADIUS * np.asarray(self._light[:2]) / self._light[2]
        return positions[..., :2] - slant * np.asarray(scales)[:, None]

    def _part_shade(self, points: np.ndarray, world: WorldConfig) -> np.ndarray:
        """Return the light (H, W) that the world's parts leave on the floor: 1 outside shadows."""
        shade = np.ones(points.shape[:2], np.float32)
        boxes = world_boxes(world)
        if not boxes:
            return shade
        origins = np.concatenate([points, np.zeros((*points.shape[:2], 1))], -1).reshape(-1, 3)
        light = np.array(self._light) / np.linalg.norm(self._light)
        grid = PENUMBRA * np.linspace(-1, 1, 5)
        directions = [light + np.array([dx, dy, 0]) for dx in grid for dy in grid]
        for direction in directions:
            rays = np.broadcast_to(direction, origins.shape)
            hidden = np.any([np.isfinite(box.intersect(origins, rays)) for box in boxes], axis=0)
            shade -= hidden.reshape(shade.shape) * np.float32(SHADOW_DEPTH / len(directions))
        return shade
