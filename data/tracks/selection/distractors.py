"""Makes selection items with distractors that differ visibly from the target."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from typing import Any

import numpy as np

from data.records import Candidate, FrameRef, Scene, SelectionItem
from data.world.displacement import (
    cross_scene_displacement,
    frame_displacements,
    visible_positions,
)

BUILDERS_VERSIONS = {"paper": "7", "balanced": "8"}
"""Version of the code that makes items and queries, by the recipe of the distractors. Increase it
when a change gives other items or queries for the same scenes."""

Pool = tuple[Iterable[Candidate], int]
"""Possible distractors in order of preference, and the maximum number of them to use."""


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


@dataclass(frozen=True)
class Family:
    """How the items of a family are made.

    Attributes:
        cells: How to construct the items of each subtype.
        timings: Function that returns the timings that items of a subtype can have in a scene.
        make_item: Function that makes the item of a subtype at one of these timings, or None.
    """

    cells: Mapping[str, Any]
    timings: Callable[[str, Scene], list[Timing]]
    make_item: Callable[..., SelectionItem | None]


@dataclass
class DistractorPicker:
    """Makes items whose candidates differ visibly from each other.

    Attributes:
        min_displacement: Between any two candidates, the position of at least one object must
            differ by this many px at 336 x 336.
        scene_ids: Scenes of the split; cross-scene distractors come from these.
        scene_of: Function that loads a scene by its id.
        dropped: Number of timings for which fewer than three distractors were found.
    """

    min_displacement: float
    scene_ids: list[str]
    scene_of: Callable[[str], Scene]
    dropped: int = 0

    def make_item(
        self,
        scene: Scene,
        timing: Timing,
        make_pools: Callable[[], Sequence[Pool]],
        about: tuple[int, ...] | None = None,
        **fields: Any,
    ) -> SelectionItem | None:
        """Make an item from the first distractors of each pool that differ by `min_displacement`.

        Args:
            make_pools: Function that returns the possible distractors. It is a function because
                `BalancedPicker` does not need them, and computing them takes time.
            about: Indices of the objects whose positions count in frames of the item's scene; None
                for all objects. In frames of other scenes, all objects count.
            fields: Fields of the item, as for `new_item`.

        Returns:
            An item whose first candidate is the target (`data.tracks.quota.fill_quota` shuffles
            the candidates), or None if fewer than three distractors differ enough.
        """
        pools = make_pools()
        chosen = [Candidate(scene.scene_id, timing.target)]
        for k, (pool, count) in enumerate(pools):
            # Stop if the remaining pools cannot complete the item.
            if len(chosen) + sum(limit for _, limit in pools[k:]) < 4:
                break
            fitting = (
                candidate
                for candidate in pool
                if all(
                    self._displacement(candidate, c, about) >= self.min_displacement for c in chosen
                )
            )
            # `fitting` is lazy, so it also compares each candidate with those chosen in this loop.
            for candidate in islice(fitting, min(count, 4 - len(chosen))):
                chosen.append(candidate)
        if len(chosen) < 4:
            self.dropped += 1
            return None
        least = min(self._displacement(a, b) for a, b in combinations(chosen, 2))
        return new_item(scene, timing, chosen, least, **fields)

    def sample_scenes(self, scene: Scene, rng: np.random.Generator, count: int) -> list[Scene]:
        """Sample up to `count` + 1 other scenes of the split. Scenes that share more objects with
        `scene` come first."""
        names = rng.choice(self.scene_ids, min(count + 1, len(self.scene_ids)), replace=False)
        scenes = [self.scene_of(str(name)) for name in names if name != scene.scene_id]
        return sorted(scenes, key=lambda s: -len({*scene.objects} & {*s.objects}))

    def _displacement(
        self, a: FrameRef, b: FrameRef, about: tuple[int, ...] | None = None
    ) -> float:
        scene = self.scene_of(a.scene_id)
        if a.scene_id == b.scene_id:
            return float(frame_displacements(scene, about)[a.frame, b.frame])
        return cross_scene_displacement(scene, a.frame, self.scene_of(b.scene_id), b.frame)


def new_item(
    scene: Scene,
    timing: Timing,
    candidates: Sequence[Candidate],
    min_displacement: float,
    *,
    family: str,
    subtype: str,
    suite: str = "dynapix",
    **fields: Any,
) -> SelectionItem:
    """Return an item whose first candidate is the target.

    Args:
        fields: The question, and the other fields of the item that apply to its family.
    """
    return SelectionItem(
        item_id=f"{family}-{subtype}-{scene.scene_id}-{timing.target}",
        split=scene.split,
        suite=suite,
        family=family,
        subtype=subtype,
        scene_id=scene.scene_id,
        prefix_start=timing.start,
        prefix_stop=timing.stop,
        target_frame=timing.target,
        event_frame=timing.event,
        candidates=tuple(candidates),
        answer=0,
        min_displacement=min_displacement,
        **fields,
    )


def balance_in_time(
    pool: Iterable[Candidate], target: int, rng: np.random.Generator
) -> tuple[Pool, Pool, Pool]:
    """Divide a pool so that a random number (0 to 3) of the distractors precedes the target.

    The pools are frames before the target, frames after it, and all frames in case these are too
    few. Without this, the candidates' order in time would often reveal the target.
    """
    pool = list(pool)
    earlier = int(rng.integers(4))
    before = [c for c in pool if c.frame < target]
    after = [c for c in pool if c.frame > target]
    return (before, earlier), (after, 3 - earlier), (pool, 3)


def visible_objects(scene: Scene, timing: Timing) -> tuple[int, ...]:
    """Return the indices of the objects that are visible in at least one frame of the prefix.

    Only these objects may distinguish candidates of one scene, because a model cannot predict that
    another object will enter.
    """
    visible = visible_positions(scene)[1][timing.start : timing.stop + 1]
    return tuple(np.flatnonzero(visible.any(axis=0)).tolist())


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Yield frames of a scene as candidates with this `source`."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)
