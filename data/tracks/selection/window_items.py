"""The window family: items whose target is a few frames (the horizon) after the prefix.

A cell has a group of events (see `window_group`), a window family, a horizon in frames and a
difficulty. The window family selects the objects of the item, among the objects on screen in the
prefix (A: all, B: the pair of the next collision, C: the object that moves most). Similarity and
minimum displacement are computed for these objects only. Distractors of hard items are the frames
most similar to the target; those of easy items are random frames of the less similar half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product

import numpy as np

from conf.schema.benchmark import WINDOW_DIFFICULTIES, WINDOW_FAMILIES, WINDOW_HORIZONS
from data.records import Scene, SelectionItem
from data.tracks.selection.balanced_items import Picker
from data.tracks.selection.distractors import (
    Family,
    Pool,
    Timing,
    balance_in_time,
    scene_candidates,
    visible_objects,
)
from data.world.displacement import object_match_scores, visible_positions
from data.world.events import collisions_in, window_group

QUESTION = "Which image best matches the next scene state?"
OBSERVED = 16
"""Default number of frames of a prefix."""


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


def timings(subtype: str, scene: Scene, observed: int = OBSERVED) -> list[Timing]:
    """Return all timings with a prefix of `observed` frames and the horizon of the cell;
    `make_item` then checks the group."""
    horizon = CELLS[subtype].horizon
    stops = range(observed - 1, scene.frames - horizon)
    return [Timing(stop - observed + 1, stop, stop + horizon) for stop in stops]


def make_item(
    subtype: str, scene: Scene, timing: Timing, rng: np.random.Generator, picker: Picker
) -> SelectionItem | None:
    """Make an item at a timing. Returns None also if the timing belongs to another group, or if no
    object of `subject_objects` is on screen in the prefix."""
    cell = CELLS[subtype]
    if window_group(scene, timing.start, timing.stop, cell.horizon) != cell.group:
        return None
    visible = visible_objects(scene, timing)
    subjects = subject_objects(cell, scene, timing)
    about = visible if subjects is None else tuple(k for k in subjects if k in visible)
    if not about:
        return None
    is_hard = cell.difficulty == "hard"
    source = "same_near" if is_hard else "same_far"

    def make_pools() -> Sequence[Pool]:
        similar = np.argsort(object_match_scores(scene, timing.target, about), kind="stable")
        frames = np.array(timing.outside_prefix(similar[similar != timing.target]))
        if not is_hard:
            # Shuffled, because the least similar frames are consecutive and the target would stand
            # out.
            frames = rng.permutation(frames[len(frames) // 2 :])
        return balance_in_time(scene_candidates(scene, frames, source), timing.target, rng)

    return picker.make_item(
        scene,
        timing,
        make_pools,
        about,
        family="window",
        subtype=subtype,
        question=QUESTION,
        distractors=source,
        **asdict(cell),
    )


def subject_objects(cell: WindowCell, scene: Scene, timing: Timing) -> tuple[int, ...] | None:
    """Return the indices of the objects that the window family selects; None for all objects.

    The tuple is empty if no collision occurs up to the target (B), or nothing visible moves (C).
    """
    stop, target = timing.stop, timing.target
    if cell.window_family == "A":
        return None
    if cell.window_family == "B":
        ahead = collisions_in(scene, stop + 1, target)
        return ahead[0].objects if ahead else ()
    positions, visible = visible_positions(scene)
    moved = np.linalg.norm(positions[target] - positions[stop], axis=-1)
    moved[~(visible[target] & visible[stop])] = 0
    return (int(moved.argmax()),) if moved.max() > 0 else ()


FAMILY = Family(CELLS, timings, make_item)
