"""Events of a scene: contacts of objects, view and occlusion changes, and motion onsets.

A scene records every contact of every pair. A pair that touches in the first frame is in contact
from the start: this contact is no event.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dynapix.data.records import Collision, Scene
from dynapix.data.sim.physics import break_frames

Pair = tuple[int, int]
OCCLUDED = 0.5
"""Visible fraction below which an object is occluded."""
ONSET = 0.01
"""Distance from its initial position at which an object counts as moving, simulator units."""
ONSET_FRAMES = 3
"""Number of consecutive frames beyond `ONSET` that make the first of them a motion onset."""
REST_FRAMES = 10
"""Number of initial frames in which the object must stay within half of `ONSET`."""


def group_contacts(touching: Mapping[Pair, Iterable[int]], fps: float) -> tuple[Collision, ...]:
    """Group the frames in which pairs touch into contacts, in order of frame.

    A contact ends when more frames without touch follow than `data.sim.physics.break_frames`
    allows at the frame rate.
    """
    contacts = []
    for pair, frames in touching.items():
        touches = np.sort([*frames])
        ends = np.flatnonzero(np.diff(touches) > break_frames(fps) + 1) + 1
        for run in np.split(touches, ends):
            if len(run):
                contacts.append(Collision(int(run[0]), tuple(sorted(pair)), int(run[-1])))
    return tuple(sorted(contacts, key=lambda contact: (contact.frame, contact.objects)))


def collisions_in(scene: Scene, first: int, last: int) -> list[Collision]:
    """Return the contacts that begin at frames `first` to `last`, inclusive, and not at frame 0."""
    return [c for c in scene.collisions if max(first, 1) <= c.frame <= last]


def collision_frames(scene: Scene) -> list[int]:
    """Return the frames at which contacts begin, in order, without repetitions."""
    return list(dict.fromkeys(c.frame for c in collisions_in(scene, 1, scene.frames)))


def next_collision(scene: Scene, frame: int) -> Collision | None:
    """Return the first contact that begins after a frame, or None."""
    return next(iter(collisions_in(scene, frame + 1, scene.frames)), None)


def is_next(scene: Scene, frame: int, collision: int) -> bool:
    """Return whether the first contact that begins after a frame begins at frame `collision`."""
    following = next_collision(scene, frame)
    return following is not None and following.frame == collision


def first_collisions(scene: Scene) -> list[Collision]:
    """Return the first contact of each pair that does not touch from the start, in order."""
    first: dict[Pair, Collision] = {}
    for contact in scene.collisions:
        first.setdefault(contact.objects, contact)
    return [contact for contact in first.values() if contact.frame > 0]


def touching_pairs(scene: Scene, first: int, last: int) -> set[Pair]:
    """Return the pairs that are in contact at any of the frames `first` to `last`."""
    return {c.objects for c in scene.collisions if c.frame <= last and c.end >= first}


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
