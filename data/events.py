"""What happens in a stretch of a scene: collisions, entering and leaving, occlusion changes, and
the window family's group."""

from __future__ import annotations

import numpy as np

from data.records import Collision, Scene

OCCLUDED = 0.5
"""An object is occluded where less than this share of it is visible."""


def collisions_in(scene: Scene, first: int, last: int) -> list[Collision]:
    """Collisions at frames first to last, inclusive."""
    return [c for c in scene.collisions if first <= c.frame <= last]


def view_changes_in(scene: Scene, first: int, last: int) -> int:
    """How often an object enters or leaves view at frames first to last, inclusive."""
    return _changes(scene.in_view, first, last)


def occlusion_changes_in(scene: Scene, first: int, last: int) -> int:
    """How often an object in view becomes occluded or free at frames first to last, inclusive."""
    return _changes(scene.in_view & (scene.visible_fraction < OCCLUDED), first, last)


def _changes(state: np.ndarray, first: int, last: int) -> int:
    stretch = state[max(first - 1, 0) : last + 1]
    return int((stretch[1:] != stretch[:-1]).sum())


def window_group(scene: Scene, start: int, stop: int, horizon: int) -> str:
    """The group of a window item by its future-event structure, the first that holds: G4 several
    events ahead, G2 one collision ahead, G3 an occlusion or view change (the latter seen or
    ahead), G1 nothing."""
    ahead = (stop + 1, stop + horizon)
    collisions, changes = len(collisions_in(scene, *ahead)), view_changes_in(scene, *ahead)
    if collisions + changes >= 2:
        return "G4"
    if collisions == 1:
        return "G2"
    seen = (start + 1, stop)
    if changes or view_changes_in(scene, *seen) or occlusion_changes_in(scene, *seen):
        return "G3"
    return "G1"
