"""Makes the items of each cell from scenes in a seeded order, until its quota is reached."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from data.records import SPLITS, Scene, SelectionItem
from data.tracks.selection.balanced_items import BalancedPicker, Picker
from data.tracks.selection.distractors import DistractorPicker, Family

if TYPE_CHECKING:
    from conf.schema import Quota, WorldConfig

Element = TypeVar("Element")


@dataclass(frozen=True)
class CellInputs:
    """The inputs for making the items or queries of one cell.

    Attributes:
        scene_ids: Scene ids by split.
        scene_of: Function that loads a scene by its id.
        min_displacement: Minimum displacement between two candidates, px at 336 x 336.
        hard_negatives: Number of hard negatives of a query.
        world: The world of the scenes, if the items are balanced.
        save: Function that stores an alternative future of a balanced item.
    """

    scene_ids: dict[str, list[str]]
    scene_of: Callable[[str], Scene]
    quota: Quota
    seed: int
    min_displacement: float
    hard_negatives: int = 0
    world: WorldConfig | None = None
    save: Callable[[Scene], None] | None = None

    def make_picker(self, split: str, rng: np.random.Generator) -> Picker:
        """Return the picker of distractors for the items of a split."""
        if self.world is not None:
            return BalancedPicker(self.min_displacement, self.world, rng, self.save)
        return DistractorPicker(self.min_displacement, self.scene_ids[split], self.scene_of)


def fill_quota(subtype: str, family: Family, cell: CellInputs) -> tuple[list[SelectionItem], int]:
    """Make the items of one cell, at most one per scene, from scenes in a seeded order.

    The timings of a scene are tried in a random order.

    Returns:
        The items of each split up to its quota, and the number of timings that were dropped because
        no three distractors are suitable.
    """
    items, dropped = [], 0
    for split in SPLITS:
        scene_ids = cell.scene_ids[split]
        rng = named_rng(cell.seed, subtype, split)
        picker = cell.make_picker(split, rng)
        made: list[SelectionItem] = []
        for index in rng.permutation(len(scene_ids)):
            if len(made) == getattr(cell.quota, split):
                break
            scene = cell.scene_of(scene_ids[index])
            timings = family.timings(subtype, scene)
            order = rng.permutation(len(timings))
            attempts = (family.make_item(subtype, scene, timings[k], rng, picker) for k in order)
            made += islice(filter(None, attempts), 1)
        items += shuffle_candidates(made, rng)
        dropped += picker.dropped
    return items, dropped


def shuffle_candidates(
    items: Sequence[SelectionItem], rng: np.random.Generator
) -> list[SelectionItem]:
    """Return items with their candidates in a random order, each letter being the answer equally
    often. Where the number of items is not divisible by 4, a random first letter decides which
    letters are the answer once more."""
    positions = rng.permutation((np.arange(len(items)) + rng.integers(4)) % 4)
    shuffled = []
    for item, position in zip(items, positions.tolist(), strict=True):
        distractors = [c for k, c in enumerate(item.candidates) if k != item.answer]
        candidates = [distractors[k] for k in rng.permutation(3)]
        candidates.insert(position, item.candidates[item.answer])
        shuffled.append(replace(item, candidates=tuple(candidates), answer=position))
    return shuffled


def named_rng(seed: int, *names: str) -> np.random.Generator:
    """Return a random generator for a seed and names. Each cell has a generator of its own, so that
    the quota of a cell does not affect other cells."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])


def round_robin(queues: Iterable[Iterable[Element]]) -> Iterator[Element]:
    """Yield the next element of each queue in turn, until all are exhausted. Queues are lazy."""
    waiting = [iter(queue) for queue in queues]
    while waiting:
        for queue in list(waiting):
            try:
                yield next(queue)
            except StopIteration:
                waiting.remove(queue)


def interleave(elements: Iterable[Element], key: Callable[[Element], Hashable]) -> list[Element]:
    """Order elements so that the first element of every key comes first, then the second element of
    every key, and so on."""
    turns: dict[Hashable, Iterator[int]] = defaultdict(count)
    # `sorted` calls its key once for each element, in order.
    return sorted(elements, key=lambda element: next(turns[key(element)]))
