"""Events of a scene besides contacts: view and occlusion changes, window groups, motion onsets."""

from __future__ import annotations

import numpy as np

from dynapix.data.oracle.contacts import collisions_in
from dynapix.data.records import Scene

OCCLUDED = 0.5
"""Visible fraction below which an object is occluded."""
ONSET = 0.01
"""Distance from its initial position at which an object counts as moving, simulator units."""
ONSET_FRAMES = 3
"""Number of consecutive frames beyond `ONSET` that make the first of them a motion onset."""
REST_FRAMES = 10
"""Number of initial frames in which the object must stay within half of `ONSET`."""


def _changes_in(states: np.ndarray, first: int, last: int) -> int:
    """Count the changes of the objects' boolean states (F, N) at frames `first` to `last`."""
    window = states[max(first - 1, 0) : last + 1]
    return int((window[1:] != window[:-1]).sum())


def window_group(scene: Scene, start: int, stop: int, horizon: int) -> str:
    """Return the group of a window item: the first in this list whose condition holds.

    G4: two or more collisions or view changes after the prefix, up to the target. G2: one collision
    there. G3: a view change there or in the prefix, or an occlusion change in the prefix. G1: none
    of these. A view change is an object that enters or leaves the view.
    """
    ahead, prefix = (stop + 1, stop + horizon), (start + 1, stop)
    collisions, changes = len(collisions_in(scene, *ahead)), _changes_in(scene.in_view, *ahead)
    if collisions + changes >= 2:
        return "G4"
    if collisions == 1:
        return "G2"
    occluded = scene.in_view & (scene.visible_fraction < OCCLUDED)
    if changes or _changes_in(scene.in_view, *prefix) or _changes_in(occluded, *prefix):
        return "G3"
    return "G1"


def find_motion_onsets(scene: Scene) -> list[tuple[int, int]]:
    """Return (frame, object) for every object that starts to move after initial rest, in order."""
    distance = np.linalg.norm(scene.positions - scene.positions[0], axis=-1)
    is_away = distance > ONSET
    stays_away = np.logical_and.reduce(
        [is_away[k : len(is_away) - ONSET_FRAMES + 1 + k] for k in range(ONSET_FRAMES)]
    )
    rested = (distance[:REST_FRAMES] < ONSET / 2).all(axis=0)
    started = np.flatnonzero(rested & stays_away.any(axis=0))
    return sorted((int(stays_away[:, k].argmax()), int(k)) for k in started)
