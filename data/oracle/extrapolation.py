"""Extrapolation: where objects would be if they kept their velocities."""

from __future__ import annotations

from typing import Any

import numpy as np

from dynapix.data.records import Scene
from dynapix.data.sim.camera import Camera


def extrapolate(scene: Scene, frame: int, seconds: np.ndarray | float) -> np.ndarray:
    """Return the positions (N, 3) of the objects some seconds after a frame, at the velocities of
    that frame; (T, N, 3) for seconds (T, 1, 1)."""
    return scene.positions[frame] + seconds * scene.velocities[frame]


def project(positions: np.ndarray, scene: Scene, config: dict[str, Any]) -> np.ndarray | None:
    """Return the image positions (..., 2), px of the scene's image, of positions (..., 3).

    Args:
        config: The settings of the scene's benchmark, from its manifest.

    Returns:
        None for releases whose scenes record no camera.
    """
    if config["simulator"] in ("movi_a", "physion"):
        return None
    if config["simulator"] == "tracks":
        # Positions are those of the image plane, in heights of the image with y up.
        return (positions[..., :2] * [1, -1] + [0, 1]) * scene.image_size[1]
    return Camera.from_settings(config["world"]["camera"]).project(positions)[0]
