"""Contacts and landings of Physion's raw trials, from the contacts that each frame lists.

Early files have no `states` of collisions, and `env_collisions` mixes walls and floor. The `labels`
are not used: `target_on_ground` is set when the contacts with the floor change, and
`target_delta_position` accumulates.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from data.records import Collision, Landing
from data.releases.hdf5 import get_group, locate, read_floats, read_integers
from data.releases.validation import RecordError
from data.world.events import first_contacts

if TYPE_CHECKING:
    import h5py

ABSENT_FRAMES = 5
"""Without states, a pair that is first listed before this frame is in contact from the start."""
AIR_FRAMES = 5
"""Least number of frames without contact before a landing."""
UPRIGHT = 0.7
"""Least upward share of a floor contact's normal."""
FLOOR = 0.05
"""Greatest height of a contact with the floor, metres."""


def find_collisions(frames: list[h5py.Group], ids: list[int]) -> tuple[Collision, ...]:
    """Return the first contacts of pairs that are not in contact from the start.

    A contact begins at the first frame at which a pair enters it or, without states, is listed.
    """
    entered, from_start = [], set()
    for k, frame in enumerate(frames):
        for pair, state in _read_pairs(frame):
            if not set(pair) <= set(ids) or pair[0] == pair[1]:
                continue
            first, second = sorted(ids.index(name) for name in pair)
            if state in (b"enter", None):
                entered.append((k, (first, second)))
            if k == 0 or (state is None and k < ABSENT_FRAMES):
                from_start.add((first, second))
    return first_contacts((k, pair) for k, pair in entered if pair not in from_start)


def _read_pairs(frame: h5py.Group) -> list[tuple[list[int], bytes | None]]:
    """The pairs of object ids that a frame lists, each with its state, None if not recorded."""
    collisions = get_group(frame, "collisions")
    pairs = read_integers(collisions, "object_ids", 2).tolist()
    if "states" not in collisions:
        return [(pair, None) for pair in pairs]
    states = [bytes(state) for state in collisions["states"][()].reshape(-1)]
    if len(states) != len(pairs):
        raise RecordError(f"{locate(collisions)} has {len(states)} states of {len(pairs)} pairs")
    return list(zip(pairs, states, strict=True))


def find_landings(
    frames: list[h5py.Group], ids: list[int], positions: np.ndarray
) -> tuple[Landing, ...]:
    """Return each object's first contact with the floor after some frames without any contact.

    Args:
        positions: (F, N, 3) centres in TDW's axes.
    """
    in_air = np.zeros(len(ids), int)
    landed: dict[int, int] = {}
    for k, frame in enumerate(frames):
        environment = get_group(frame, "env_collisions")
        listed = read_integers(environment, "object_ids")
        touching = [n for n, name in enumerate(ids) if name in listed]
        for n in _find_on_floor(environment, touching, positions[k]):
            if in_air[n] >= AIR_FRAMES:
                landed.setdefault(n, k)
        in_contact = [
            name for pair, state in _read_pairs(frame) if state != b"exit" for name in pair
        ]
        in_air = np.where(np.isin(ids, [*in_contact, *listed]), 0, in_air + 1)
    return tuple(Landing(k, n) for k, n in sorted((k, n) for n, k in landed.items()))


def _find_on_floor(environment: h5py.Group, touching: list[int], positions: np.ndarray) -> set[int]:
    """Those of the objects touching walls or floor that touch the floor.

    Points are not listed by object: each is assigned to the nearest object, seen from above.
    """
    contacts = read_floats(environment, "contacts", shape=(None, 2, 3))
    normals, points = contacts[:, 0], contacts[:, 1]
    floor = points[(normals[:, 1] > UPRIGHT) & (np.abs(points[:, 1]) < FLOOR)]
    if not touching:
        return set()
    distances = np.linalg.norm((floor[:, None] - positions[touching])[..., [0, 2]], axis=-1)
    return {touching[n] for n in distances.argmin(axis=1)}
