"""The window family: which frame shows the scene a short horizon after the observation.

A cell is a group by what happens ahead, a family that says what the item is built around (A: the
whole scene), a horizon in frames, and a difficulty: hard keeps the frames most alike to the target
among those that can still be told apart, easy the least alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from data.events import window_group
from data.geometry import object_match
from data.records import Scene
from data.selection.drafts import Draft, Picker, same_scene

QUESTION = "Which image best matches the next scene state?"
PREFIX_FRAMES = 16
HORIZONS = (8, 16, 24)
DIFFICULTIES = ("easy", "hard")
FAMILIES_OF_GROUP = {"G1": "A", "G2": "A", "G3": "A", "G4": "A"}


@dataclass(frozen=True)
class WindowCell:
    group: str
    window_family: str
    horizon: int
    difficulty: str


CELLS = {
    f"{group}_{family}_h{horizon}_{difficulty}": WindowCell(group, family, horizon, difficulty)
    for group, families in FAMILIES_OF_GROUP.items()
    for family, horizon, difficulty in product(families, HORIZONS, DIFFICULTIES)
}


def draft(subtype: str, scene: Scene, rng: np.random.Generator, picker: Picker) -> Draft | None:
    """An item at one of the scene's windows that fall in the cell's group, tried in a random
    order."""
    cell = CELLS[subtype]
    last_start = scene.frames - PREFIX_FRAMES - cell.horizon
    for start in rng.permutation(last_start + 1).tolist():
        stop = start + PREFIX_FRAMES - 1
        if window_group(scene, start, stop, cell.horizon) != cell.group:
            continue
        target = stop + cell.horizon
        unlike = np.argsort(object_match(scene, target), kind="stable")
        pool = unlike if cell.difficulty == "hard" else unlike[::-1]
        source = "same_near" if cell.difficulty == "hard" else "same_far"
        picked = picker.pick(scene, target, pool[pool != target])
        if picked is None:
            continue
        frames, apart = picked
        return Draft(
            scene,
            "window",
            subtype,
            QUESTION,
            (start, stop),
            target,
            same_scene(scene, frames, source),
            apart,
            {
                "distractors": source,
                "horizon": cell.horizon,
                "group": cell.group,
                "window_family": cell.window_family,
                "difficulty": cell.difficulty,
            },
        )
    return None
