"""Held-out training scenes, on which runs are evaluated while they train; no test scenes."""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.data.store import Store

HELD_OUT_SHARE = 0.1
"""Share of the training scenes that are held out."""

Row = TypeVar("Row")


def held_out_scenes(store: Store) -> set[str]:
    """Return the names of the held-out training scenes, at least one if there are any scenes.

    Whether a scene is held out depends on its name, not on a run's seed or on the other scenes.
    The runs that train a base and a student over it thus hold out the same scenes.
    """
    names = store.scene_ids("train")
    # In a small benchmark, no scene may be below the share.
    held_out = {name for name in names if name_fraction(name) < HELD_OUT_SHARE}
    return held_out or set(sorted(names, key=name_fraction)[:1])


def name_fraction(name: str) -> float:
    """Map a name to a number in [0, 1) by its hash."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2**64


def shuffled(rows: list[Row], seed: int) -> list[Row]:
    """Return the rows in a random order, which the seed determines."""
    return [rows[k] for k in np.random.default_rng([seed, 2]).permutation(len(rows))]


def check_not_empty(count: int, what: str, command: str = "data.build") -> None:
    """Raise UserError if `count` is 0.

    Args:
        what: Names the missing items, queries or rationales.
        command: The command whose report explains why there are none.
    """
    if count == 0:
        raise UserError(
            f"there are no {what}: python -m {command} reports why",
            code="no-training-data",
        )
