"""Static parts of a world: the boxes that form its ramps, walls and screens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynapix.conf.schema import PartConfig, WorldConfig
from dynapix.data.sim.shapes import CORNERS, intersect_box, rotation_matrix

HIGH = 100.0
"""A height above all parts, simulator units."""


@dataclass(frozen=True)
class Box:
    """A box: its centre, its orientation (x y z w), and the halves of its edges."""

    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    half: tuple[float, ...]

    @property
    def corners(self) -> np.ndarray:
        """(8, 3) corners in world coordinates."""
        return np.array(self.position) + (CORNERS * self.half) @ rotation_matrix(self.quaternion).T

    def intersect(self, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return each ray's parameter at its first intersection with the box; inf for none."""
        to_local = rotation_matrix(self.quaternion)
        origin = (eye - np.array(self.position)) @ to_local
        return intersect_box(np.array(self.half), origin, rays @ to_local)


def world_boxes(world: WorldConfig) -> tuple[Box, ...]:
    """Return the parts of a world as boxes, in the order of the settings."""
    return tuple(part_box(part) for part in world.parts.values())


def part_box(part: PartConfig) -> Box:
    """Return the box of a part: tilted about its y axis, and then turned about the vertical."""
    tilt, turn = np.radians([part.tilt, part.turn]) / 2
    # The product of the quaternions of the turn (about z) and the tilt (about y).
    quaternion = (
        float(-np.sin(turn) * np.sin(tilt)),
        float(np.cos(turn) * np.sin(tilt)),
        float(np.sin(turn) * np.cos(tilt)),
        float(np.cos(turn) * np.cos(tilt)),
    )
    return Box(tuple(part.position), quaternion, tuple(size / 2 for size in part.size))


def surface_height(boxes: Sequence[Box], place: np.ndarray) -> float:
    """Return the height of the highest surface at a ground position (2,); 0 is the floor."""
    above, down = np.array([*place, HIGH]), np.array([[0.0, 0.0, -1.0]])
    hits = [float(box.intersect(above, down)[0]) for box in boxes]
    return max([0.0, *(HIGH - hit for hit in hits if np.isfinite(hit))])
