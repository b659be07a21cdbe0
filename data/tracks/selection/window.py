"""The window family: which frame shows the scene a short horizon after the observation.

A cell is a group by what happens ahead, a family that says what the item is built around (A: the
whole scene, B: the pair of the next collision, C: the object that moves most), a horizon in frames,
and a difficulty: hard keeps the frames most alike to the target among those that can still be told
apart, easy takes any of the less alike half. Alike and apart go by the objects that the item is
built around.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from conf.schema.benchmark import WINDOW_DIFFICULTIES, WINDOW_FAMILIES, WINDOW_HORIZONS
from data.records import FrameRef, Scene
from data.tracks.selection.distractors import (
    DistractorPicker,
    Draft,
    outside_prefix,
    scene_candidates,
    visible_objects,
)
from data.world.displacement import object_match_scores, on_screen_positions
from data.world.events import collisions_in, window_group

QUESTION = "Which image best matches the next scene state?"
PREFIX_FRAMES = 16


@dataclass(frozen=True)
class WindowCell:
    group: str
    window_family: str
    horizon: int
    difficulty: str


CELLS = {
    f"{group}_{family}_h{horizon}_{difficulty}": WindowCell(group, family, horizon, difficulty)
    for group, families in WINDOW_FAMILIES.items()
    for family, horizon, difficulty in product(families, WINDOW_HORIZONS, WINDOW_DIFFICULTIES)
}


def draft(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> Draft | None:
    """An item at one of the scene's windows that fall in the cell's group, tried in a random
    order."""
    cell = CELLS[subtype]
    last_start = scene.frames - PREFIX_FRAMES - cell.horizon
    for start in rng.permutation(last_start + 1).tolist():
        stop = start + PREFIX_FRAMES - 1
        if window_group(scene, start, stop, cell.horizon) != cell.group:
            continue
        target = stop + cell.horizon
        about = built_around(cell, scene, stop, target)
        seen = visible_objects(scene, (start, stop))
        about = seen if about is None else tuple(k for k in about if k in seen)
        if about == ():
            continue
        alike = np.argsort(object_match_scores(scene, target, about), kind="stable")
        alike = np.array(outside_prefix(alike[alike != target], (start, stop)))
        if cell.difficulty == "hard":
            pool, source = alike, "same_near"
        else:
            # Any of the far half: the farthest of all are neighbours, which leaves the target odd.
            pool, source = rng.permutation(alike[len(alike) // 2 :]), "same_far"
        wrong = scene_candidates(scene, pool, source)
        earlier = int(rng.integers(4))
        picked = picker.pick(FrameRef(scene.scene_id, target), wrong, about, earlier)
        if picked is None:
            continue
        return Draft(
            scene,
            "window",
            subtype,
            QUESTION,
            (start, stop),
            target,
            *picked,
            {
                "distractors": source,
                "horizon": cell.horizon,
                "group": cell.group,
                "window_family": cell.window_family,
                "difficulty": cell.difficulty,
            },
        )
    return None


def built_around(cell: WindowCell, scene: Scene, stop: int, target: int) -> tuple[int, ...] | None:
    """The objects that an item is built around: None for the whole scene, none at all where the
    stretch ahead has nothing of the kind."""
    if cell.window_family == "A":
        return None
    if cell.window_family == "B":
        ahead = collisions_in(scene, stop + 1, target)
        return ahead[0].objects if ahead else ()
    places, shown = on_screen_positions(scene)
    moved = np.linalg.norm(places[target] - places[stop], axis=-1)
    moved[~(shown[target] & shown[stop])] = 0
    return (int(moved.argmax()),) if moved.max() > 0 else ()
