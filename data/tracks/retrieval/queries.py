"""Parts that the builders of queries share: quotas spread over scenes, and hard negatives."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from conf.schema import Quota
from data.records import SPLITS, RetrievalQuery, Scene
from data.tracks.quota import named_rng, round_robin
from data.world.displacement import frame_displacements

OFFSETS = (16, 32, 48)
"""Preferred offsets of hard negatives from the target, in frames on either side."""
DENSE_STEP = 4
"""Step in frames of the denser grid for targets whose preferred offsets do not suffice."""

Timing = TypeVar("Timing")


def fill_quota(
    builder: str,
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    seed: int,
    timings_of: Callable[[Scene], Sequence[Timing]],
    make_query: Callable[[Scene, Timing, np.random.Generator], RetrievalQuery | None],
    one_a_scene: bool = False,
) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder up to its quota in each split.

    Scenes are in a seeded order and give one query each before any gives a second one, so that
    queries spread over scenes.

    Returns:
        The queries, and the number of timings that were dropped because too few distinguishable
        hard negatives exist.
    """
    queries: list[RetrievalQuery] = []
    dropped = 0
    for split in SPLITS:
        rng = named_rng(seed, "retrieval", builder, split)
        wanted = getattr(quota, split)
        timings: dict[str, list[Timing]] = {}
        for index in rng.permutation(len(scene_ids[split])) if wanted else ():
            scene = scene_of(scene_ids[split][index])
            every = timings_of(scene)
            timings[scene.scene_id] = [every[k] for k in rng.permutation(len(every))]

        def attempts(
            scene_id: str, remaining: list[Timing], rng: np.random.Generator = rng
        ) -> Iterator[RetrievalQuery | None]:
            while remaining:
                query = make_query(scene_of(scene_id), remaining.pop(), rng)
                if query is not None and one_a_scene:
                    remaining.clear()
                yield query

        made: list[RetrievalQuery] = []
        for query in round_robin(attempts(*entry) for entry in timings.items()):
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
