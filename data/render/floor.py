"""Brightness of the floor: light that decreases with distance, and the objects' soft shadows."""

from __future__ import annotations

import numpy as np

from data.world.camera import Camera
from data.world.shapes import RADIUS

SHADOW_DEPTH = 0.55
"""Fraction of the light that a shadow removes at its centre."""

_SPREAD = 2 * (0.85 * RADIUS) ** 2
"""Twice the variance of a shadow's Gaussian profile, squared simulator units."""
_REACH = 1.0
"""Half the side of the square in which a shadow is computed, simulator units. At distances d above
0.984 a shadow is below float32 precision: SHADOW_DEPTH * exp(-d^2 / _SPREAD) < 2^-25."""


class Floor:
    """The floor as one camera sees it; `light` is the direction towards the light."""

    def __init__(self, camera: Camera, light: tuple[float, float, float]) -> None:
        self._camera, self._light = camera, light
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.rays(columns.astype(float), rows.astype(float))
        reach = camera.eye[2] / -rays[..., 2]
        points = np.asarray(camera.eye)[:2] + reach[..., None] * rays[..., :2]
        distance = np.linalg.norm(points - np.array([0.3, 0.0]), axis=-1)
        self._lit = (1.12 / (1 + (distance / 7.5) ** 2)).astype(np.float32)
        # x is equal along an image row, because the camera looks along the x-z plane.
        self._y = points[..., 1].astype(np.float32).astype(float)
        self._x = points[:, :1, 0].astype(np.float32).astype(float)

    def shade(self, positions: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        """Compute the brightness of the floor with the objects' shadows.

        Args:
            positions: (N, 3) positions of the objects.
            boxes: (N, 4) bounding boxes of their shadows, from `shadow_boxes`.

        Returns:
            (H, W) float32 factors for the colour of the floor.
        """
        shade = self._lit.copy()
        for (x, y), (left, top, right, bottom) in zip(
            self._shadow_centres(positions).tolist(), boxes.tolist(), strict=True
        ):
            if left < right and top < bottom:
                box = np.s_[top:bottom, left:right]
                squares = (self._y[box] - y) ** 2 + (self._x[top:bottom] - x) ** 2
                shade[box] *= 1 - SHADOW_DEPTH * np.exp(-squares / _SPREAD)
        return shade

    def shadow_boxes(self, positions: np.ndarray) -> np.ndarray:
        """Compute the bounding boxes of the shadows in the image.

        Args:
            positions: (..., 3) positions of the objects.

        Returns:
            (..., 4) left, top, right and bottom in pixels; right and bottom are exclusive.
        """
        ground = np.zeros(positions.shape)
        ground[..., :2] = self._shadow_centres(positions)
        corners = _REACH * np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]])
        # `project` places a corner behind the camera far below the image; the box is then clipped.
        pixels, _ = self._camera.project(ground[..., None, :] + corners)
        size = self._camera.width, self._camera.height
        boxes = np.concatenate([pixels.min(axis=-2), pixels.max(axis=-2) + 1], axis=-1)
        return np.clip(boxes, 0, [*size, *size]).astype(int)

    def _shadow_centres(self, positions: np.ndarray) -> np.ndarray:
        """Return the (..., 2) centres of the shadows of objects at (..., 3) positions."""
        return positions[..., :2] - 0.5 * RADIUS * np.asarray(self._light[:2]) / self._light[2]
