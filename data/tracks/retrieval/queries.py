"""Parts that the builders of queries share: quotas spread over scenes, and hard negatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np

from data.records import SPLITS, RetrievalQuery, Scene
from data.tracks.quota import CellInputs, named_rng, round_robin
from data.world.displacement import frame_displacements

OFFSETS = (16, 32, 48)
"""Preferred offsets of hard negatives from the target, in frames on either side."""
DENSE_STEP = 4
"""Step in frames of the denser grid for targets whose preferred offsets do not suffice."""

Timing = TypeVar("Timing")


def fill_quota(
    builder: str,
    cell: CellInputs,
    timings_of: Callable[[Scene], Iterable[Timing]],
    make_query: Callable[[Scene, Timing, np.random.Generator], RetrievalQuery | None],
    one_per_scene: bool = False,
) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder up to its quota in each split.

    Scenes are in a seeded order and give one query each before any gives a second one, so that
    queries spread over scenes.

    Returns:
        The queries, and the number of timings that were dropped because too few distinguishable
        hard negatives exist.
    """

    def attempts(
        scene_id: str, timings: list[Timing], rng: np.random.Generator
    ) -> Iterator[RetrievalQuery | None]:
        for timing in timings:
            query = make_query(cell.scene_of(scene_id), timing, rng)
            yield query
            if query is not None and one_per_scene:
                return

    queries: list[RetrievalQuery] = []
    dropped = 0
    for split in SPLITS:
        rng = named_rng(cell.seed, "retrieval", builder, split)
        scene_ids, wanted = cell.scene_ids[split], getattr(cell.quota, split)
        queues = []
        for index in rng.permutation(len(scene_ids)) if wanted else ():
            timings = list(timings_of(cell.scene_of(scene_ids[index])))
            order = rng.permutation(len(timings))[::-1]
            queues.append(attempts(scene_ids[index], [timings[k] for k in order], rng))
        made: list[RetrievalQuery] = []
        for query in round_robin(queues):
            if query is None:
                dropped += 1
                continue
            made.append(query)
            if len(made) == wanted:
                break
        queries += made
    return queries, dropped


def pick_hard_negatives(
    scene: Scene, target: int, count: int, least: float, rng: np.random.Generator
) -> list[int] | None:
    """Pick `count` frames that differ from the target and each other by `least` px at 336.

    Returns:
        Frame indices, or None where there are fewer.
    """
    displacements = frame_displacements(scene)
    preferred = [target + side * offset for offset in OFFSETS for side in (-1, 1)]
    dense = list(range(target % DENSE_STEP, scene.frames, DENSE_STEP))
    chosen = [target]
    for frame in [*rng.permutation(preferred), *rng.permutation(dense)]:
        if len(chosen) == count + 1:
            break
        if 0 <= frame < scene.frames and displacements[frame, chosen].min() >= least:
            chosen.append(int(frame))
    return chosen[1:] if len(chosen) == count + 1 else None
