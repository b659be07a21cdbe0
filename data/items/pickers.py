"""Makes the items of a cell from its recipe: timings, candidates that differ visibly, quotas.

A cell is one kind of items. Its recipe (`data.items.recipes`) says where the prefix and the target
can be in a scene, which objects the item is about, and which frames can be distractors. A picker
chooses the distractors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from dynapix.conf.schema import Quota
from dynapix.data.oracle.displacement import (
    cross_scene_displacement,
    frame_displacements,
    visible_positions,
)
from dynapix.data.records import SPLITS, Candidate, FrameRef, Scene, SelectionItem
from dynapix.data.seeded_order import named_rng

Pool = tuple[Iterable[Candidate], int]
"""Possible distractors in order of preference, and the maximum number of them to use."""


@dataclass(frozen=True)
class CellInputs:
    """The inputs for making the items or queries of one cell.

    Attributes:
        min_displacement: Between any two candidates, the position of at least one object (of the
            subjects, if both are frames of the item's scene) must differ by this many px at
            336 x 336.
        hard_negatives: Number of hard negatives of a query.
    """

    scene_ids: dict[str, list[str]]
    scene_of: Callable[[str], Scene]
    quota: Quota
    seed: int
    min_displacement: float
    hard_negatives: int = 0


@dataclass(frozen=True)
class Timing:
    """Frame indices of an item: its prefix (`stop` included), its target, and its event, if any."""

    start: int
    stop: int
    target: int
    event: int | None = None

    @property
    def observed(self) -> int:
        """Number of frames of the prefix."""
        return self.stop - self.start + 1

    def outside_prefix(self, frames: Iterable[int]) -> list[int]:
        """Return the frames outside the prefix; a model would recognise frames from inside it."""
        return [int(f) for f in frames if not self.start <= f <= self.stop]


def visible_objects(scene: Scene, timing: Timing) -> tuple[int, ...]:
    """Return the indices of the objects that are visible in a frame of the prefix. Only these may
    distinguish candidates of one scene: a model cannot predict that another object will enter."""
    visible = visible_positions(scene)[1][timing.start : timing.stop + 1]
    return tuple(np.flatnonzero(visible.any(axis=0)).tolist())


@dataclass(frozen=True)
class Recipe:
    """How the items of one cell are made.

    Attributes:
        timings: Returns the timings that an item can have in a scene.
        fields: Returns the item's question, its subtype and what else depends on the cell.
        pools: Returns the possible distractors of an item.
        subjects: Returns the indices of the objects whose positions count in frames of the item's
            scene. Without any, there is no item at this timing. In frames of other scenes, all
            objects count.
        lacks: What a scene without timings lacks, if such scenes are counted.
    """

    family: str
    timings: Callable[[Scene], list[Timing]]
    fields: Callable[[Timing], Mapping[str, Any]]
    pools: Callable[[Scene, Timing, DistractorPicker], Sequence[Pool]]
    subjects: Callable[[Scene, Timing], tuple[int, ...]] = visible_objects
    suite: str = "dynapix"
    lacks: str = ""


@dataclass
class DistractorPicker:
    """Takes the first distractors of the recipe's pools that differ visibly from each other.

    Cross-scene distractors come from the scenes of the split. `dropped` counts timings at which no
    item can be made because too few distractors differ from the target and from each other.
    """

    inputs: CellInputs
    split: str
    rng: np.random.Generator
    dropped: Counter[str] = field(default_factory=Counter)

    def make_item(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | None:
        """Return an item whose first candidate is the target, or None if too few distractors are
        suitable."""
        pools = recipe.pools(scene, timing, self)
        chosen = [Candidate(scene.scene_id, timing.target)]
        for k, (pool, count) in enumerate(pools):
            # Stop if the remaining pools cannot complete the item.
            if len(chosen) + sum(limit for _, limit in pools[k:]) < 4:
                break
            wanted, bound = min(len(chosen) + count, 4), self.inputs.min_displacement
            for candidate in pool:
                if len(chosen) == wanted:
                    break
                if all(self._displacement(candidate, c, subjects) >= bound for c in chosen):
                    chosen.append(candidate)
        if len(chosen) < 4:
            self.dropped["too few suitable distractors"] += 1
            return None
        least = min(self._displacement(a, b) for a, b in combinations(chosen, 2))
        return new_item(recipe, scene, timing, chosen, least)

    def _displacement(
        self, a: FrameRef, b: FrameRef, subjects: tuple[int, ...] | None = None
    ) -> float:
        scene = self.inputs.scene_of(a.scene_id)
        if a.scene_id == b.scene_id:
            return float(frame_displacements(scene, subjects)[a.frame, b.frame])
        return cross_scene_displacement(scene, a.frame, self.inputs.scene_of(b.scene_id), b.frame)


def new_item(
    recipe: Recipe,
    scene: Scene,
    timing: Timing,
    candidates: Sequence[Candidate],
    min_displacement: float,
    **fields: Any,
) -> SelectionItem:
    """Return an item whose first candidate is the target. `fields` replace those of the recipe."""
    values = {"suite": recipe.suite, **recipe.fields(timing), **fields}
    return SelectionItem(
        item_id=f"{recipe.family}-{values['subtype']}-{scene.scene_id}-{timing.target}",
        split=scene.split,
        family=recipe.family,
        scene_id=scene.scene_id,
        prefix_start=timing.start,
        prefix_stop=timing.stop,
        target_frame=timing.target,
        event_frame=timing.event,
        candidates=tuple(candidates),
        answer=0,
        min_displacement=min_displacement,
        **values,
    )


def fill_quota(
    cell_name: str,
    recipe: Recipe,
    inputs: CellInputs,
    make_picker: Callable[..., DistractorPicker] = DistractorPicker,
) -> tuple[list[SelectionItem], Counter[str]]:
    """Make the items of one cell, at most one per scene, from scenes in a seeded order. An item has
    the first timing, in a random order, at which one can be made.

    Returns:
        The items of each split up to its quota, and the number of timings that were dropped by
        reason, with that of the scenes that lack timings.
    """
    items, dropped = [], Counter[str]()
    for split in SPLITS:
        scene_ids = inputs.scene_ids[split]
        rng = named_rng(inputs.seed, cell_name, split)
        picker = make_picker(inputs, split, rng)
        made: list[SelectionItem] = []
        for index in rng.permutation(len(scene_ids)):
            if len(made) == getattr(inputs.quota, split):
                break
            scene = inputs.scene_of(scene_ids[index])
            timings = recipe.timings(scene)
            if recipe.lacks and not timings:
                dropped[recipe.lacks] += 1
            for timing in (timings[k] for k in rng.permutation(len(timings))):
                subjects = recipe.subjects(scene, timing)
                if subjects and (item := picker.make_item(recipe, scene, timing, subjects)):
                    made.append(item)
                    break
        items += shuffle_candidates(made, rng)
        dropped += picker.dropped
    return items, dropped


def shuffle_candidates(
    items: Sequence[SelectionItem], rng: np.random.Generator
) -> list[SelectionItem]:
    """Return items with their candidates in a random order, each letter being the answer equally
    often. If 4 does not divide their number, random letters are the answer once more than the
    others."""
    positions = rng.permutation((np.arange(len(items)) + rng.integers(4)) % 4)
    shuffled = []
    for item, position in zip(items, positions.tolist(), strict=True):
        distractors = [c for k, c in enumerate(item.candidates) if k != item.answer]
        candidates = [distractors[k] for k in rng.permutation(3)]
        candidates.insert(position, item.candidates[item.answer])
        shuffled.append(replace(item, candidates=tuple(candidates), answer=position))
    return shuffled
