"""Functions that all builders of queries share: they fill a quota and choose hard negatives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from data.records import SPLITS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs, named_rng, round_robin
from data.world.displacement import cross_scene_displacement, frame_displacements

OFFSETS = (16, 32, 48)
"""Preferred offsets of hard negatives from the target, in frames on either side."""
DENSE_STEP = 4
"""Step in frames of the grid from which hard negatives are chosen if `OFFSETS` do not suffice."""


def fill_query_quota(
    builder: str,
    cell: CellInputs,
    queries_of: Callable[[Scene], Iterable[RetrievalQuery]],
    one_per_scene: bool = False,
) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder up to its quota in each split.

    Scenes take turns in a seeded order: each gives one query before any gives a second one.

    Args:
        queries_of: Function that returns all queries about a scene, for `add_hard_negatives`.
        one_per_scene: Whether a scene gives at most one query.

    Returns:
        The queries, and the number of queries that were dropped because they have too few
        distinguishable hard negatives.
    """

    def attempts(
        queries: list[RetrievalQuery], rng: np.random.Generator
    ) -> Iterator[RetrievalQuery | None]:
        for query in queries:
            completed = add_hard_negatives(query, cell, rng)
            yield completed
            if completed is not None and one_per_scene:
                return

    made: list[RetrievalQuery] = []
    dropped = 0
    for split in SPLITS:
        rng = named_rng(cell.seed, "retrieval", builder, split)
        scene_ids, wanted = cell.scene_ids[split], getattr(cell.quota, split) + len(made)
        queues = []
        for index in rng.permutation(len(scene_ids)) if wanted > len(made) else ():
            queries = list(queries_of(cell.scene_of(scene_ids[index])))
            order = rng.permutation(len(queries))[::-1]
            queues.append(attempts([queries[k] for k in order], rng))
        for query in round_robin(queues):
            if query is None:
                dropped += 1
                continue
            made.append(query)
            if len(made) == wanted:
                break
    return made, dropped


def add_hard_negatives(
    query: RetrievalQuery, cell: CellInputs, rng: np.random.Generator
) -> RetrievalQuery | None:
    """Complete a query's hard negatives with other frames of its target's scene.

    The added frames differ from the target, from each other and from the hard negatives that the
    query already has by at least `cell.min_displacement`.

    Returns:
        The query, or None if there are too few such frames.
    """
    scene, target = cell.scene_of(query.target.scene_id), query.target.frame
    displacements = frame_displacements(scene)
    preferred = [target + side * offset for offset in OFFSETS for side in (-1, 1)]
    dense = list(range(target % DENSE_STEP, scene.frames, DENSE_STEP))
    count = 1 + cell.hard_negatives - len(query.hard_negatives)
    chosen = [target]
    for frame in [*rng.permutation(preferred), *rng.permutation(dense)]:
        if len(chosen) == count:
            break
        if (
            0 <= frame < scene.frames
            and displacements[frame, chosen].min() >= cell.min_displacement
        ):
            chosen.append(int(frame))
    wrong = chosen[1:]
    if len(chosen) < count or any(
        cross_scene_displacement(cell.scene_of(given.scene_id), given.frame, scene, frame)
        < cell.min_displacement
        for given in query.hard_negatives
        for frame in wrong
    ):
        return None
    negatives = (FrameRef(scene.scene_id, frame) for frame in wrong)
    return replace(query, hard_negatives=(*query.hard_negatives, *negatives))
