"""Contacts of objects, and what follows from them: the next collision, first and repeated ones.

A scene records every contact of every pair. A pair that touches in the first frame is in contact
from the start: this contact is no event.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from dynapix.data.records import Collision, Scene
from dynapix.data.sim.physics import break_frames

Pair = tuple[int, int]


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
