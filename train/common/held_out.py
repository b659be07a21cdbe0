"""Held-out training scenes, on which runs are evaluated. Test scenes are never used in training."""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np

from conf.errors import UserError
from data.store import Store

HELD_OUT = 0.1
"""Share of the training scenes that are held out."""

Row = TypeVar("Row")


def held_out_scenes(store: Store) -> set[str]:
    """Return the names of the held-out training scenes, at least one.

    The choice depends on each scene's name only, not on a run's seed or on the other scenes: a base
    must not have been trained on a scene that evaluates a student trained over it.
    """
    names = store.scene_ids("train")
    # A store of a few scenes may have none below the bound.
    return {n for n in names if name_fraction(n) < HELD_OUT} or {min(names, key=name_fraction)}


def name_fraction(name: str) -> float:
    """Map a name to a number in [0, 1) by its hash."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2**64


def shuffled(rows: list[Row], seed: int) -> list[Row]:
    """Return the rows in an order that depends on the seed."""
    return [rows[k] for k in np.random.default_rng([seed, 2]).permutation(len(rows))]


def check_not_empty(count: int, what: str) -> None:
    """Raise UserError if nothing remains to train on or to evaluate."""
    if count == 0:
        raise UserError(
            f"no {what} remain: see the shortfalls that python -m data.build prints and the "
            "rejects that python -m teacher.narrate prints",
            code="no-training-data",
        )
