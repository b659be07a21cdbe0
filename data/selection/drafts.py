"""What the three families share: a draft item, distractors that can be told apart, the quotas.

A family's module offers `CELLS`, its cells by subtype, and `draft(cell, scene, ...)`, which makes
at most one item of a cell from a scene. `fill` draws scenes until a cell has its quota.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from conf.schema import Quota
from data.geometry import DIAGONAL, displacements
from data.records import SPLITS, Candidate, Scene, SelectionItem

BUILDERS_VERSION = "2"
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


@dataclass
class Picker:
    """Picks distractors that can be told apart, and counts the targets for which it could not.

    `least` is the least displacement between two candidates (px at 336 x 336, in some object).
    """

    least: float
    dropped: int = 0

    def pick(
        self, scene: Scene, target: int, pool: Iterable[int]
    ) -> tuple[list[int], float] | None:
        """The first three frames of `pool` that can be told apart from the target and each other,
        and the least displacement among the four; None where there are no such three."""
        apart = displacements(scene)
        chosen = [target]
        for frame in pool:
            if apart[frame, chosen].min() >= self.least:
                chosen.append(int(frame))
                if len(chosen) == 4:
                    among = apart[np.ix_(chosen, chosen)][np.triu_indices(4, 1)]
                    return chosen[1:], float(min(among.min(), DIAGONAL))
        self.dropped += 1
        return None


Draw = Callable[[Scene, np.random.Generator, Picker], Draft | None]
"""Makes at most one draft of a cell from a scene."""


def same_scene(scene: Scene, frames: Sequence[int], source: str) -> tuple[Candidate, ...]:
    return tuple(Candidate(scene.scene_id, frame, source) for frame in frames)


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
    items, picker = [], Picker(least)
    for split in SPLITS:
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
    return items, picker.dropped


def finish(draft: Draft, position: int, rng: np.random.Generator) -> SelectionItem:
    """Put the target at `position` among the shuffled distractors."""
    scene = draft.scene
    candidates = [draft.distractors[k] for k in rng.permutation(3)]
    candidates.insert(position, Candidate(scene.scene_id, draft.target, "target"))
    return SelectionItem(
        item_id=f"{draft.family}-{draft.subtype}-{scene.scene_id}-{draft.target}",
        split=scene.split,
        suite="dynapix",
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
