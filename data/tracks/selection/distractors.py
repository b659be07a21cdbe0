"""What the three families share: a draft item, distractors that can be told apart, the quotas.

A family's module offers `CELLS`, its cells by subtype, and `draft(cell, scene, ...)`, which makes
at most one item of a cell from a scene. `fill` draws scenes until a cell has its quota.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from conf.schema import Quota
from data.records import SPLITS, Candidate, FrameRef, Scene, SelectionItem
from data.world.displacement import (
    cross_scene_displacement,
    frame_displacements,
    on_screen_positions,
)

BUILDERS_VERSION = "5"
"""Of the items' and queries' builders: changes whenever the same scenes would give others."""


@dataclass(frozen=True)
class Draft:
    """An item whose answer has no position yet. `axes` are the construction axes that apply."""

    scene: Scene
    family: str
    subtype: str
    question: str
    prefix: tuple[int, int]
    target: int
    distractors: tuple[Candidate, ...]
    min_displacement: float
    axes: dict[str, Any] = field(default_factory=dict)
    suite: str = "dynapix"


@dataclass
class DistractorPicker:
    """Picks distractors that can be told apart, and counts the targets for which it could not.

    `least` is the least displacement between two candidates (px at 336 x 336, in some object);
    `scene_ids` are the scenes of the split, to which cross-scene distractors keep.
    """

    least: float
    scene_ids: list[str]
    scene_of: Callable[[str], Scene]
    dropped: int = 0

    def pick(
        self,
        target: FrameRef,
        pool: Iterable[Candidate],
        about: tuple[int, ...] | None = None,
        earlier: int | None = None,
    ) -> tuple[tuple[Candidate, ...], float] | None:
        """The first three of `pool` that can be told apart from the target and each other, by one
        of the objects `about` where those are given, and the least displacement between any two of
        the four; None where there are no such three.

        `earlier` of the three come from before the target and the others from after it, as far as
        the pool has such: a target that always stands in the midst of its distractors, or before
        them, could be told without the prefix.
        """
        if earlier is None:
            return self.pick_each(target, (pool, 3), about=about)
        pool = list(pool)
        before = [c for c in pool if c.frame < target.frame]
        after = [c for c in pool if c.frame > target.frame]
        chosen = self._take([target], before, earlier, about)
        chosen = self._take(chosen, after, 3 - earlier, about)
        return self._picked(self._take(chosen, pool, 4 - len(chosen), about))

    def pick_each(
        self,
        target: FrameRef,
        *pools: tuple[Iterable[Candidate], int],
        about: tuple[int, ...] | None = None,
    ) -> tuple[tuple[Candidate, ...], float] | None:
        """As `pick`, so many of each of several pools."""
        chosen: list[FrameRef] = [target]
        for pool, count in pools:
            wanted = len(chosen) + count
            chosen = self._take(chosen, pool, count, about)
            if len(chosen) < wanted:
                break
        return self._picked(chosen)

    def _take(
        self,
        chosen: list[FrameRef],
        pool: Iterable[Candidate],
        count: int,
        about: tuple[int, ...] | None,
    ) -> list[FrameRef]:
        """`chosen` and the first `count` of a pool that can be told apart from it and each other,
        or as many as there are."""
        taken = list(chosen)
        for candidate in pool if count else ():
            if all(self._apart(candidate, c, about) >= self.least for c in taken):
                taken.append(candidate)
                if len(taken) == len(chosen) + count:
                    break
        return taken

    def _picked(self, chosen: list[FrameRef]) -> tuple[tuple[Candidate, ...], float] | None:
        if len(chosen) < 4:
            self.dropped += 1
            return None
        least = min(self._apart(a, b, None) for a, b in combinations(chosen, 2))
        return tuple(chosen[1:]), least

    def _apart(self, one: FrameRef, two: FrameRef, about: tuple[int, ...] | None) -> float:
        scene = self.scene_of(one.scene_id)
        if one.scene_id == two.scene_id:
            return float(frame_displacements(scene, about)[one.frame, two.frame])
        return cross_scene_displacement(scene, one.frame, self.scene_of(two.scene_id), two.frame)

    def others(self, scene: Scene, rng: np.random.Generator, count: int) -> list[Scene]:
        """So many other scenes of the split in a random order, those that share most of the
        scene's objects first."""
        drawn = rng.choice(self.scene_ids, min(count + 1, len(self.scene_ids)), replace=False)
        scenes = [self.scene_of(str(name)) for name in drawn if name != scene.scene_id]
        looks = set(scene.objects)
        return sorted(scenes, key=lambda s: -len(looks & set(s.objects)))


Draw = Callable[[Scene, np.random.Generator, DistractorPicker], Draft | None]
"""Makes at most one draft of a cell from a scene."""


def visible_objects(scene: Scene, prefix: tuple[int, int]) -> tuple[int, ...]:
    """The objects that show in a prefix. No other can tell candidates apart: nothing is known of
    where it comes in."""
    start, stop = prefix
    return tuple(
        np.flatnonzero(on_screen_positions(scene)[1][start : stop + 1].any(axis=0)).tolist()
    )


def outside_prefix(frames: Iterable[int], prefix: tuple[int, int]) -> list[int]:
    """The frames that are not in a prefix. One that was shown is told by comparing."""
    start, stop = prefix
    return [int(f) for f in frames if not start <= f <= stop]


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Frames of a scene as candidates."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)


def fill(
    subtype: str,
    draw: Draw,
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    seed: int,
    least: float,
) -> tuple[list[SelectionItem], int]:
    """Items of one cell up to its quota in each split, at most one a scene, scenes in a seeded
    order, and how many targets were dropped for want of distractors that can be told apart. What
    falls short is the caller's to report."""
    items, dropped = [], 0
    for split in SPLITS:
        picker = DistractorPicker(least, scene_ids[split], scene_of)
        rng = cell_rng(seed, subtype, split)
        drafts: list[Draft] = []
        for index in rng.permutation(len(scene_ids[split])):
            if len(drafts) == getattr(quota, split):
                break
            drafted = draw(scene_of(scene_ids[split][index]), rng, picker)
            if drafted is not None:
                drafts.append(drafted)
        # Every letter is the answer equally often in a random order; the remainder starts at a
        # random letter, or the last letter would be right in fewer cells than the first.
        positions = rng.permutation((np.arange(len(drafts)) + rng.integers(4)) % 4)
        items += [finish(d, int(p), rng) for d, p in zip(drafts, positions, strict=True)]
        dropped += picker.dropped
    return items, dropped


def finish(draft: Draft, position: int, rng: np.random.Generator) -> SelectionItem:
    """Put the target at `position` among the shuffled distractors."""
    scene = draft.scene
    candidates = [draft.distractors[k] for k in rng.permutation(3)]
    candidates.insert(position, Candidate(scene.scene_id, draft.target, "target"))
    return SelectionItem(
        item_id=f"{draft.family}-{draft.subtype}-{scene.scene_id}-{draft.target}",
        split=scene.split,
        suite=draft.suite,
        family=draft.family,
        subtype=draft.subtype,
        question=draft.question,
        scene_id=scene.scene_id,
        prefix_start=draft.prefix[0],
        prefix_stop=draft.prefix[1],
        target_frame=draft.target,
        candidates=tuple(candidates),
        answer=position,
        min_displacement=draft.min_displacement,
        **draft.axes,
    )


def cell_rng(seed: int, *names: str) -> np.random.Generator:
    """A generator of its own for each cell and split, so that one quota moves no other cell."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])
