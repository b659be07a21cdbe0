"""A pinhole camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import radians, tan
from typing import Any

import numpy as np

from dynapix.conf.schema import CameraConfig

WIDTH, HEIGHT = 480, 320
"""Size in px of the image plane to which the image positions of a simulated scene refer."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in a world whose z axis points up. The defaults approximate the camera of
    the CLEVRER dataset."""

    width: int = WIDTH
    height: int = HEIGHT
    focal: float = 525.0
    """Focal length, px."""
    eye: tuple[float, float, float] = (4.3301, 0.0, 2.5)
    """Position of the camera in the world."""
    aim: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point in the middle of the image."""

    @classmethod
    def from_settings(cls, settings: CameraConfig | Mapping[str, Any]) -> Camera:
        """Return the camera of a world's settings; the focal length is rounded to 0.01 px."""
        values = settings if isinstance(settings, Mapping) else vars(settings)
        focal = round(WIDTH / 2 / tan(radians(values["field_of_view"]) / 2), 2)
        return cls(WIDTH, HEIGHT, focal, tuple(values["position"]), tuple(values["aim"]))

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, down and forward in world coordinates."""
        sight = np.subtract(self.aim, self.eye)
        forward = sight / np.linalg.norm(sight)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def magnification(self) -> float:
        """Length in px of a simulator unit in the middle of the image."""
        return self.focal / float(np.linalg.norm(np.subtract(self.aim, self.eye)))

    def sized(self, width: int, height: int) -> Camera:
        """Return this camera at another resolution, with the same horizontal field of view."""
        return replace(self, width=width, height=height, focal=self.focal * width / self.width)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixel coordinates (..., 2) of world points (..., 3), and their depths (...)
        along the optical axis."""
        local = (points - np.asarray(self.eye)) @ self.axes.T
        depth = local[..., 2]
        # Points behind the camera get finite coordinates that mean nothing: the caller has depths.
        clamped = np.maximum(depth, 1e-3)
        centre = np.array([self.width / 2, self.height / 2])
        return centre + self.focal * local[..., :2] / clamped[..., None], depth

    def rays(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return world directions (..., 3), not normalised, through the centres of pixels."""
        x = (columns + 0.5 - self.width / 2) / self.focal
        y = (rows + 0.5 - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.axes


@lru_cache(maxsize=16)
def pixel_rays(camera: Camera) -> np.ndarray:
    """Return world directions (H, W, 3), not normalised, through the centres of all pixels."""
    return camera.rays(*np.meshgrid(np.arange(camera.width), np.arange(camera.height)))
