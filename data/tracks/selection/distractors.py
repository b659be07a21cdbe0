"""Distractors that differ visibly from the target, and items made of them.

A family's module has `CELLS`, its cells by subtype, and `make_item(subtype, scene, ...)`, which
makes at most one item of a cell from a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from data.records import Candidate, FrameRef, Scene, SelectionItem
from data.world.displacement import (
    cross_scene_displacement,
    frame_displacements,
    on_screen_positions,
)

BUILDERS_VERSION = "5"
"""Version of the item and query builders: changes whenever the same scenes would give others."""

Picked = tuple[tuple[Candidate, ...], float]
"""Three distractors, and the smallest displacement between two of the four candidates (px)."""


@dataclass
class DistractorPicker:
    """Picks three distractors that differ visibly from the target and from each other.

    Attributes:
        least: Smallest displacement between two candidates, px at 336 x 336, in some object.
        scene_ids: Scenes of the split; cross-scene distractors come from these.
        scene_of: Loads a scene by its id.
        dropped: Number of targets for which no three such distractors exist.
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
    ) -> Picked | None:
        """Pick the first three of `pool` that differ enough; None where there are fewer.

        Args:
            about: Indices of the objects that must differ; any object by default.
            earlier: How many of the three come from before the target, as far as the pool has
                such frames. Without this balance the target's place in time among the candidates
                would reveal the answer.
        """
        if earlier is None:
            return self.pick_each(target, (pool, 3), about=about)
        pool = list(pool)
        before = [c for c in pool if c.frame < target.frame]
        after = [c for c in pool if c.frame > target.frame]
        chosen = self._extend([target], before, earlier, about)
        chosen = self._extend(chosen, after, 3 - earlier, about)
        return self._finish(self._extend(chosen, pool, 4 - len(chosen), about))

    def pick_each(
        self,
        target: FrameRef,
        *pools: tuple[Iterable[Candidate], int],
        about: tuple[int, ...] | None = None,
    ) -> Picked | None:
        """Pick the given number of distractors from each of several pools."""
        chosen: list[FrameRef] = [target]
        for pool, count in pools:
            wanted = len(chosen) + count
            chosen = self._extend(chosen, pool, count, about)
            if len(chosen) < wanted:
                break
        return self._finish(chosen)

    def sample_scenes(self, scene: Scene, rng: np.random.Generator, count: int) -> list[Scene]:
        """Sample other scenes of the split, sorted by how many objects they share with `scene`."""
        names = rng.choice(self.scene_ids, min(count + 1, len(self.scene_ids)), replace=False)
        scenes = [self.scene_of(str(name)) for name in names if name != scene.scene_id]
        looks = set(scene.objects)
        return sorted(scenes, key=lambda s: -len(looks & set(s.objects)))

    def _extend(
        self,
        chosen: list[FrameRef],
        pool: Iterable[Candidate],
        count: int,
        about: tuple[int, ...] | None,
    ) -> list[FrameRef]:
        """Append the first `count` frames of a pool that differ from all chosen ones."""
        extended = list(chosen)
        for candidate in pool if count else ():
            if all(self._displacement(candidate, c, about) >= self.least for c in extended):
                extended.append(candidate)
                if len(extended) == len(chosen) + count:
                    break
        return extended

    def _finish(self, chosen: list[FrameRef]) -> Picked | None:
        if len(chosen) < 4:
            self.dropped += 1
            return None
        least = min(self._displacement(a, b, None) for a, b in combinations(chosen, 2))
        return tuple(chosen[1:]), least

    def _displacement(self, one: FrameRef, two: FrameRef, about: tuple[int, ...] | None) -> float:
        scene = self.scene_of(one.scene_id)
        if one.scene_id == two.scene_id:
            return float(frame_displacements(scene, about)[one.frame, two.frame])
        return cross_scene_displacement(scene, one.frame, self.scene_of(two.scene_id), two.frame)


def new_item(
    scene: Scene,
    family: str,
    subtype: str,
    question: str,
    prefix: tuple[int, int],
    target: int,
    picked: Picked,
    suite: str = "dynapix",
    **axes: Any,
) -> SelectionItem:
    """An item with the target as its first candidate; `axes` are the construction axes that apply.

    `data.tracks.quota.fill_quota` shuffles the candidates.
    """
    distractors, least = picked
    return SelectionItem(
        item_id=f"{family}-{subtype}-{scene.scene_id}-{target}",
        split=scene.split,
        suite=suite,
        family=family,
        subtype=subtype,
        question=question,
        scene_id=scene.scene_id,
        prefix_start=prefix[0],
        prefix_stop=prefix[1],
        target_frame=target,
        candidates=(Candidate(scene.scene_id, target), *distractors),
        answer=0,
        min_displacement=least,
        **axes,
    )


def visible_objects(scene: Scene, prefix: tuple[int, int]) -> tuple[int, ...]:
    """Indices of the objects on screen in a prefix.

    Only these may distinguish candidates, because the entry of another object is unpredictable.
    """
    start, stop = prefix
    return tuple(
        np.flatnonzero(on_screen_positions(scene)[1][start : stop + 1].any(axis=0)).tolist()
    )


def outside_prefix(frames: Iterable[int], prefix: tuple[int, int]) -> list[int]:
    """The frames that are not part of a prefix: a frame of it is recognisable by comparison."""
    start, stop = prefix
    return [int(f) for f in frames if not start <= f <= stop]


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Frames of a scene as candidates of one source."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)
