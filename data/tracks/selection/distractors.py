"""Selection items with distractors that differ visibly from the target."""

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
    on_screen_positions,
)

BUILDERS_VERSION = "5"
"""Version of the item and query builders. Increase it when a change makes the same scenes yield
other items or queries."""

Pool = tuple[Iterable[Candidate], int]
"""Possible distractors, best first, and the maximum number of them to use."""


@dataclass(frozen=True)
class Timing:
    """Frame indices of an item: its prefix (`stop` included), its target, and its event, if any."""

    start: int
    stop: int
    target: int
    event: int | None = None

    def outside_prefix(self, frames: Iterable[int]) -> list[int]:
        """Return the frames that are outside the prefix: a model could recognise the others."""
        return [int(f) for f in frames if not self.start <= f <= self.stop]


@dataclass(frozen=True)
class Family:
    """How the items of a family are made.

    Attributes:
        cells: How to construct the items of each subtype.
        timings: Returns the timings that items of a subtype can have in a scene.
        make_item: Makes the item of a subtype at one of these timings, or returns None.
    """

    cells: Mapping[str, Any]
    timings: Callable[[str, Scene], list[Timing]]
    make_item: Callable[..., SelectionItem | None]


@dataclass
class DistractorPicker:
    """Makes items whose candidates differ visibly from each other.

    Attributes:
        min_displacement: Between any two candidates, at least one object must move by this many px
            at 336 x 336.
        scene_ids: Scenes of the split; cross-scene distractors come from these.
        scene_of: Loads a scene by its id.
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
        pools: Sequence[Pool],
        about: tuple[int, ...] | None = None,
        *,
        family: str,
        subtype: str,
        suite: str = "dynapix",
        **fields: Any,
    ) -> SelectionItem | None:
        """Make an item from the first distractors of each pool that differ by `min_displacement`.

        Args:
            about: Indices of objects, of which at least one must move between two frames of the
                scene; None for all objects. Frames of other scenes may differ in any object.
            fields: The question and the construction axes that apply.

        Returns:
            An item whose first candidate is the target (`data.tracks.quota.fill_quota` shuffles
            them), or None if fewer than three candidates differ enough.
        """
        chosen = [Candidate(scene.scene_id, timing.target)]
        for k, (pool, count) in enumerate(pools):
            # Stop if the remaining pools cannot complete the item.
            if len(chosen) + sum(most for _, most in pools[k:]) < 4:
                break
            fitting = (
                candidate
                for candidate in pool
                if all(
                    self._displacement(candidate, c, about) >= self.min_displacement for c in chosen
                )
            )
            # `fitting` is lazy, so each candidate is also compared with those of this loop.
            for candidate in islice(fitting, min(count, 4 - len(chosen))):
                chosen.append(candidate)
        if len(chosen) < 4:
            self.dropped += 1
            return None
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
            candidates=tuple(chosen),
            answer=0,
            min_displacement=min(self._displacement(a, b) for a, b in combinations(chosen, 2)),
            **fields,
        )

    def sample_scenes(self, scene: Scene, rng: np.random.Generator, count: int) -> list[Scene]:
        """Sample about `count` other scenes of the split. Scenes that share more objects with
        `scene` come first."""
        names = rng.choice(self.scene_ids, min(count + 1, len(self.scene_ids)), replace=False)
        scenes = [self.scene_of(str(name)) for name in names if name != scene.scene_id]
        return sorted(scenes, key=lambda s: -len({*scene.objects} & {*s.objects}))

    def _displacement(
        self, one: FrameRef, two: FrameRef, about: tuple[int, ...] | None = None
    ) -> float:
        scene = self.scene_of(one.scene_id)
        if one.scene_id == two.scene_id:
            return float(frame_displacements(scene, about)[one.frame, two.frame])
        return cross_scene_displacement(scene, one.frame, self.scene_of(two.scene_id), two.frame)


def balance_in_time(
    pool: Iterable[Candidate], target: int, rng: np.random.Generator
) -> tuple[Pool, Pool, Pool]:
    """Return frames before the target, of which 0 to 3 (a random number) are used, frames after it
    for the rest, and all frames, in case too few of the others differ enough.

    Otherwise the order of the candidates in time would reveal the answer.
    """
    pool = list(pool)
    earlier = int(rng.integers(4))
    before = [c for c in pool if c.frame < target]
    after = [c for c in pool if c.frame > target]
    return (before, earlier), (after, 3 - earlier), (pool, 3)


def visible_objects(scene: Scene, timing: Timing) -> tuple[int, ...]:
    """Return the indices of the objects that are on screen in at least one frame of the prefix.

    Within a scene only these may distinguish candidates: a model cannot predict that another object
    enters.
    """
    on_screen = on_screen_positions(scene)[1][timing.start : timing.stop + 1]
    return tuple(np.flatnonzero(on_screen.any(axis=0)).tolist())


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Yield frames of a scene as candidates of one source."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)
