"""What builders of queries share: quotas spread over scenes, and wrong times of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from conf.schema import Quota
from data.records import SPLITS, RetrievalQuery, Scene
from data.tracks.selection.distractors import cell_rng
from data.world.displacement import frame_displacements

OFFSETS = (16, 32, 48)
"""First choice of hard negatives, in frames on either side of the target."""
DENSE_STEP = 4
"""Step of the denser grid that stands in where the first choices do not do."""

Moment = TypeVar("Moment")


def fill(
    builder: str,
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    seed: int,
    moments: Callable[[Scene], Sequence[Moment]],
    ask: Callable[[Scene, Moment, np.random.Generator], RetrievalQuery | None],
    one_a_scene: bool = False,
) -> tuple[list[RetrievalQuery], int]:
    """Queries of one builder up to its quota in each split, and how many moments were dropped for
    want of hard negatives that can be told apart.

    Scenes come in a seeded order and give one of their `moments` each before any gives a second,
    so that queries spread over scenes.
    """
    queries, dropped = [], 0
    for split in SPLITS:
        rng = cell_rng(seed, "retrieval", builder, split)
        wanted = getattr(quota, split)
        left = {}
        for index in rng.permutation(len(scene_ids[split])) if wanted else ():
            scene = scene_of(scene_ids[split][index])
            every = moments(scene)
            left[scene.scene_id] = [every[k] for k in rng.permutation(len(every))]
        found: list[RetrievalQuery] = []
        while len(found) < wanted and any(left.values()):
            for scene_id, waiting in left.items():
                if waiting and len(found) < wanted:
                    query = ask(scene_of(scene_id), waiting.pop(), rng)
                    if query is None:
                        dropped += 1
                        continue
                    found.append(query)
                    if one_a_scene:
                        waiting.clear()
        queries += found
    return queries, dropped


def wrong_times(
    scene: Scene, target: int, count: int, least: float, rng: np.random.Generator
) -> list[int] | None:
    """`count` frames of a scene that can be told apart from the target and each other."""
    apart = frame_displacements(scene)
    first = [target + side * offset for offset in OFFSETS for side in (-1, 1)]
    dense = list(range(target % DENSE_STEP, scene.frames, DENSE_STEP))
    chosen = [target]
    for frame in [*rng.permutation(first), *rng.permutation(dense)]:
        if len(chosen) == count + 1:
            break
        if 0 <= frame < scene.frames and apart[frame, chosen].min() >= least:
            chosen.append(int(frame))
    return chosen[1:] if len(chosen) == count + 1 else None
