"""What happens in a scene: collisions, entering and leaving, occlusion changes and the window
family's group in a stretch of it, first contacts, and what is set in motion."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from data.records import Collision, Scene

OCCLUDED = 0.5
"""An object is occluded where less than this share of it is visible."""
ONSET = 0.01
"""An object moves once it is farther than this from where it began, simulator units..."""
ONSET_FRAMES = 3
"""... and stays so for this many frames..."""
REST_FRAMES = 10
"""... where it rested, within half of that distance, for this many frames at the beginning."""


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


def first_contacts(touching: Iterable[tuple[int, tuple[int, int]]]) -> tuple[Collision, ...]:
    """The first contact of every pair, in order of frame, from any number of (frame, objects) at
    which two objects touch."""
    first: dict[tuple[int, int], int] = {}
    for frame, (one, two) in touching:
        pair = (min(one, two), max(one, two))
        first[pair] = min(frame, first.get(pair, frame))
    found = (Collision(frame, pair) for pair, frame in first.items())
    return tuple(sorted(found, key=lambda c: (c.frame, c.objects)))


def find_motion_onsets(scene: Scene) -> list[tuple[int, int]]:
    """(frame, object) of every object that is set in motion after a rest from the beginning, in
    order of frame: the first frame at which it is away from where it began, and stays away."""
    moved = np.linalg.norm(scene.positions - scene.positions[0], axis=-1)
    away = moved > ONSET
    stays = np.logical_and.reduce(
        [away[k : len(away) - ONSET_FRAMES + 1 + k] for k in range(ONSET_FRAMES)]
    )
    rested = (moved[:REST_FRAMES] < ONSET / 2).all(axis=0)
    set_off = np.flatnonzero(rested & stays.any(axis=0))
    return sorted((int(stays[:, k].argmax()), int(k)) for k in set_off)
