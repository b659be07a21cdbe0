"""A pinhole camera, and the view of a scene: its camera, floor colour and light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks at the origin of the world, whose z axis points up. The defaults
    approximate the camera of the CLEVRER dataset."""

    width: int = 480
    height: int = 320
    focal: float = 525.0
    """Focal length, px."""
    eye: tuple[float, float, float] = (4.3301, 0.0, 2.5)
    """Position of the camera in the world."""

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, down and forward in world coordinates."""
        forward = -np.asarray(self.eye) / np.linalg.norm(self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def sized(self, width: int, height: int) -> Camera:
        """Return this camera at another resolution, with the same horizontal field of view."""
        return replace(self, width=width, height=height, focal=self.focal * width / self.width)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixel coordinates (..., 2) of world points (..., 3), and their depths (...)
        along the optical axis."""
        local = (points - np.asarray(self.eye)) @ self.axes.T
        depth = local[..., 2]
        # Points behind the camera get finite coordinates.
        clamped = np.maximum(depth, 1e-3)
        centre = np.array([self.width / 2, self.height / 2])
        return centre + self.focal * local[..., :2] / clamped[..., None], depth

    def rays(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return world directions (..., 3), not normalised, through the centres of pixels."""
        x = (columns + 0.5 - self.width / 2) / self.focal
        y = (rows + 0.5 - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.axes


@dataclass(frozen=True)
class View:
    """The camera, floor colour and light of scenes."""

    camera: Camera = Camera()
    """`eye` must lie in the x-z plane, as `data.render.floor` assumes."""
    floor: tuple[float, float, float] = (158.0, 156.0, 152.0)
    """RGB colour of the floor at brightness 1, 0 to 255."""
    light: tuple[float, float, float] = (3.0, 3.0, 6.0)
    """Direction towards the light; the Blender renderer has lamps of its own."""


STANDARD_VIEW = View()
