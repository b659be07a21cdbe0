"""Events of a scene: collisions, view and occlusion changes, window groups, motion onsets."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from data.records import Collision, Scene

OCCLUDED = 0.5
"""Visible fraction below which an object is occluded."""
ONSET = 0.01
"""Distance from its initial position at which an object counts as moving, simulator units."""
ONSET_FRAMES = 3
"""Number of consecutive frames at that distance that make an onset."""
REST_FRAMES = 10
"""Number of initial frames in which the object must stay within half of that distance."""


def collision_frames(scene: Scene) -> list[int]:
    """The frames of the scene's collisions, each once, in order."""
    return list(dict.fromkeys(c.frame for c in scene.collisions))


def collisions_in(scene: Scene, first: int, last: int) -> list[Collision]:
    """Collisions at frames first to last, inclusive."""
    return [c for c in scene.collisions if first <= c.frame <= last]


def _changes_in(states: np.ndarray, first: int, last: int) -> int:
    """Number of changes of the objects' boolean states (F, N) at frames first to last."""
    window = states[max(first - 1, 0) : last + 1]
    return int((window[1:] != window[:-1]).sum())


def window_group(scene: Scene, start: int, stop: int, horizon: int) -> str:
    """The group of a window item: the first of these whose condition holds.

    G4: two or more collisions or view changes in the future window. G2: one collision in it. G3: a
    view change in the prefix or the future window, or an occlusion change in the prefix. G1: none.
    A view change is an object that enters or leaves the view.
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


def first_contacts(touching: Iterable[tuple[int, tuple[int, int]]]) -> tuple[Collision, ...]:
    """The first contact of each pair, in order of frame.

    Args:
        touching: (frame, objects) of every contact, in any order.
    """
    first: dict[tuple[int, int], int] = {}
    for frame, (one, two) in touching:
        pair = (min(one, two), max(one, two))
        first[pair] = min(frame, first.get(pair, frame))
    contacts = (Collision(frame, pair) for pair, frame in first.items())
    return tuple(sorted(contacts, key=lambda c: (c.frame, c.objects)))


def find_motion_onsets(scene: Scene) -> list[tuple[int, int]]:
    """(frame, object) of every object that starts to move after an initial rest, in order."""
    distance = np.linalg.norm(scene.positions - scene.positions[0], axis=-1)
    is_away = distance > ONSET
    stays_away = np.logical_and.reduce(
        [is_away[k : len(is_away) - ONSET_FRAMES + 1 + k] for k in range(ONSET_FRAMES)]
    )
    rested = (distance[:REST_FRAMES] < ONSET / 2).all(axis=0)
    started = np.flatnonzero(rested & stays_away.any(axis=0))
    return sorted((int(stays_away[:, k].argmax()), int(k)) for k in started)
