"""The window family: which frame shows the scene a short horizon after the observation.

A cell has a group (future events), a family, a horizon in frames and a difficulty. The family names
the objects that an item is about (A: the whole scene, B: the pair of the next collision, C: the
object that moves most). Hard items take the distractors most similar to the target, easy ones a
random part of the less similar half. Similarity and displacement count those objects alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from conf.schema.benchmark import WINDOW_DIFFICULTIES, WINDOW_FAMILIES, WINDOW_HORIZONS
from data.records import FrameRef, Scene, SelectionItem
from data.tracks.selection.distractors import (
    DistractorPicker,
    new_item,
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


def make_item(
    subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> SelectionItem | None:
    """Make an item at one of the scene's windows of the cell's group, tried in a random order."""
    cell = CELLS[subtype]
    last_start = scene.frames - PREFIX_FRAMES - cell.horizon
    for start in rng.permutation(last_start + 1).tolist():
        prefix = (start, stop) = (start, start + PREFIX_FRAMES - 1)
        if window_group(scene, start, stop, cell.horizon) != cell.group:
            continue
        target = stop + cell.horizon
        visible = visible_objects(scene, prefix)
        subjects = subject_objects(cell, scene, stop, target)
        about = visible if subjects is None else tuple(k for k in subjects if k in visible)
        if not about:
            continue
        similar = np.argsort(object_match_scores(scene, target, about), kind="stable")
        pool = np.array(outside_prefix(similar[similar != target], prefix))
        source = "same_near"
        if cell.difficulty == "easy":
            # A random order, because the most different frames are neighbours of each other, which
            # would make the target the odd one out.
            pool, source = rng.permutation(pool[len(pool) // 2 :]), "same_far"
        picked = picker.pick(
            FrameRef(scene.scene_id, target),
            scene_candidates(scene, pool, source),
            about,
            int(rng.integers(4)),
        )
        if picked is not None:
            return new_item(
                scene,
                "window",
                subtype,
                QUESTION,
                prefix,
                target,
                picked,
                distractors=source,
                horizon=cell.horizon,
                group=cell.group,
                window_family=cell.window_family,
                difficulty=cell.difficulty,
            )
    return None


def subject_objects(
    cell: WindowCell, scene: Scene, stop: int, target: int
) -> tuple[int, ...] | None:
    """Indices of the objects that an item is about.

    None stands for the whole scene; the tuple is empty where the window has no such object.
    """
    if cell.window_family == "A":
        return None
    if cell.window_family == "B":
        ahead = collisions_in(scene, stop + 1, target)
        return ahead[0].objects if ahead else ()
    positions, on_screen = on_screen_positions(scene)
    moved = np.linalg.norm(positions[target] - positions[stop], axis=-1)
    moved[~(on_screen[target] & on_screen[stop])] = 0
    return (int(moved.argmax()),) if moved.max() > 0 else ()
