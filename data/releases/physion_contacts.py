"""Contacts and landings in Physion's raw trials, from what each frame lists.

`states` of collisions is absent from early files, and `env_collisions` mixes the walls with the
floor. What `labels` tells is not used: `target_on_ground` says that the contacts with the floor
changed, and `target_delta_position` accumulates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from data.records import Collision, Landing
from data.releases import hdf5
from data.releases.validation import RecordError
from data.world.events import first_contacts

if TYPE_CHECKING:
    import h5py

ABSENT_FRAMES = 5
"""Without states, a pair that is first listed before this frame touched from the beginning."""
AIR_FRAMES = 5
"""Least number of frames without any contact before a landing."""
UPRIGHT = 0.7
"""Least upward share of a floor contact's normal."""
FLOOR = 0.05
"""Contacts this near to height 0 may be the floor's, metres."""


def collisions(moments: list[h5py.Group], ids: list[int]) -> tuple[Collision, ...]:
    """First contacts of pairs that do not touch from the beginning: the first frame at which a pair
    enters contact or, without states, is listed."""
    begun, early = [], set()
    for frame, moment in enumerate(moments):
        for listed, state in _pairs(moment):
            if not set(listed) <= set(ids) or listed[0] == listed[1]:
                continue
            one, two = sorted(ids.index(k) for k in listed)
            if state in (b"enter", None):
                begun.append((frame, (one, two)))
            if frame == 0 or (state is None and frame < ABSENT_FRAMES):
                early.add((one, two))
    return first_contacts((frame, pair) for frame, pair in begun if pair not in early)


def _pairs(moment: h5py.Group) -> list[tuple[list[int], bytes | None]]:
    """Pairs of object ids that touch or part at a frame, and the state of each, None where that is
    not recorded."""
    listed = hdf5.group(moment, "collisions")
    pairs = hdf5.integers(listed, "object_ids", 2).tolist()
    if "states" not in listed:
        return [(pair, None) for pair in pairs]
    states = [bytes(state) for state in listed["states"][()].reshape(-1)]
    if len(states) != len(pairs):
        raise RecordError(f"{hdf5.where(listed)} has {len(states)} states of {len(pairs)} pairs")
    return list(zip(pairs, states, strict=True))


def landings(
    moments: list[h5py.Group], ids: list[int], positions: np.ndarray
) -> tuple[Landing, ...]:
    """Each object's first contact with the floor after some frames without any contact; `positions`
    (F, N, 3) are in TDW's own axes."""
    in_air = np.zeros(len(ids), int)
    landed: dict[int, int] = {}
    for frame, moment in enumerate(moments):
        room = hdf5.group(moment, "env_collisions")
        listed = hdf5.integers(room, "object_ids")
        at_room = [k for k, name in enumerate(ids) if name in listed]
        for k in _on_floor(room, at_room, positions[frame]):
            if in_air[k] >= AIR_FRAMES:
                landed.setdefault(k, frame)
        met = [k for pair, state in _pairs(moment) if state != b"exit" for k in pair]
        in_air = np.where(np.isin(ids, [*met, *listed]), 0, in_air + 1)
    return tuple(Landing(frame, k) for frame, k in sorted((f, k) for k, f in landed.items()))


def _on_floor(room: h5py.Group, at_room: list[int], positions: np.ndarray) -> set[int]:
    """Which of the objects that touch walls or floor touch the floor. Points are not listed by
    object: each goes to the nearest as seen from above."""
    contacts = hdf5.array(room, "contacts", shape=(None, 2, 3))
    normals, points = contacts[:, 0], contacts[:, 1]
    floor = points[(normals[:, 1] > UPRIGHT) & (np.abs(points[:, 1]) < FLOOR)]
    if not at_room:
        return set()
    gaps = np.linalg.norm((floor[:, None] - positions[at_room])[..., [0, 2]], axis=-1)
    return {at_room[k] for k in gaps.argmin(axis=1)}
