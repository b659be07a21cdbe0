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
"""Version of the item and query builders: changes whenever the same scenes would give others."""

Pool = tuple[Iterable[Candidate], int]
"""Possible distractors, best first, and how many of them to use at most."""


@dataclass(frozen=True)
class Timing:
    """The inclusive prefix of an item, its target frame, and the frame of its event, if any."""

    start: int
    stop: int
    target: int
    event: int | None = None

    def outside_prefix(self, frames: Iterable[int]) -> list[int]:
        """The given frames outside the prefix; a model could recognise a frame that it has seen."""
        return [int(f) for f in frames if not self.start <= f <= self.stop]


@dataclass(frozen=True)
class Family:
    """How the items of a family are made.

    Attributes:
        cells: Construction cells by subtype.
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
        min_displacement: Minimum displacement of some object between two candidates, px at
            336 x 336.
        scene_ids: Scenes of the split; cross-scene distractors come from these.
        scene_of: Loads a scene by its id.
        dropped: Number of targets that had too few such distractors.
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
            about: Indices of the objects that must differ; any object by default.
            fields: The question and the construction axes that apply.

        Returns:
            An item whose first candidate is the target (`data.tracks.quota.fill_quota` shuffles
            them), or None where the pools have fewer than three such distractors.
        """
        chosen = [Candidate(scene.scene_id, timing.target)]
        for k, (pool, count) in enumerate(pools):
            if len(chosen) + sum(most for _, most in pools[k:]) < 4:
                break
            fitting = (
                candidate
                for candidate in pool
                if all(
                    self._displacement(candidate, c, about) >= self.min_displacement for c in chosen
                )
            )
            # Lazy: each candidate is compared with those that were chosen before it.
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
        """Sample other scenes of the split, sorted by how many objects they share with `scene`."""
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
    """Divide a scene's pool so that a random number of distractors, 0 to 3, precede the target.

    Otherwise the order of the candidates in time would reveal the answer. The last pool is used
    where the other two have too few frames.
    """
    pool = list(pool)
    earlier = int(rng.integers(4))
    before = [c for c in pool if c.frame < target]
    after = [c for c in pool if c.frame > target]
    return (before, earlier), (after, 3 - earlier), (pool, 3)


def visible_objects(scene: Scene, timing: Timing) -> tuple[int, ...]:
    """Indices of the objects on screen in a prefix.

    Only these may distinguish candidates, because the entry of another object is unpredictable.
    """
    on_screen = on_screen_positions(scene)[1][timing.start : timing.stop + 1]
    return tuple(np.flatnonzero(on_screen.any(axis=0)).tolist())


def scene_candidates(scene: Scene, frames: Iterable[int], source: str) -> Iterator[Candidate]:
    """Frames of a scene as candidates of one source."""
    return (Candidate(scene.scene_id, int(frame), source) for frame in frames)
