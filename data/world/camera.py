"""A pinhole camera, and the view of scenes: camera, floor and light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks at the origin, with z up; the defaults fit CLEVRER's release."""

    width: int = 480
    height: int = 320
    focal: float = 525.0
    eye: tuple[float, float, float] = (4.3301, 0.0, 2.5)

    @cached_property
    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, down and forward in world coordinates."""
        forward = -np.asarray(self.eye) / np.linalg.norm(self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def sized(self, width: int, height: int) -> Camera:
        """This camera at another resolution."""
        return replace(self, width=width, height=height, focal=self.focal * width / self.width)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (..., 3) to px (..., 2) and depths (...) along the optical axis."""
        local = (points - np.asarray(self.eye)) @ self.axes.T
        depth = local[..., 2]
        # A point behind the camera has no image; its projection stays finite and far outside.
        safe = np.maximum(depth, 1e-3)
        centre = np.array([self.width / 2, self.height / 2])
        return centre + self.focal * local[..., :2] / safe[..., None], depth

    def rays(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(P, 3) world directions through the centres of P pixels, not normalised."""
        x = (columns + 0.5 - self.width / 2) / self.focal
        y = (rows + 0.5 - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.axes


@dataclass(frozen=True)
class View:
    """The camera, floor colour and light of scenes."""

    camera: Camera = Camera()
    """Its eye must lie in the x-z plane."""
    floor: tuple[float, float, float] = (158.0, 156.0, 152.0)
    """RGB colour of the fully lit floor, 0 to 255."""
    light: tuple[float, float, float] = (3.0, 3.0, 6.0)
    """Position of the lamp."""


STANDARD_VIEW = View()
