"""Counterfactual queries, which ask for the future of a scene had one object been absent.

The scene is simulated again from the same start without the object; the target is a frame of this
counterfactual scene. The prefix shows the factual scene and ends before the object's first contact.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from data.records import COUNTERFACTUAL, FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs, named_rng
from data.tracks.retrieval.queries import fill_query_quota
from data.tracks.selection.time_items import spell_seconds
from data.world.displacement import DIAGONAL, visible_positions

LATEST_STOP = 2 * FPS
"""Maximum index of the last frame of a prefix."""
HORIZONS = (1, 2, 3)
"""Seconds from the end of the prefix to the target."""


def removed_object(scene: Scene, seed: int) -> int | None:
    """Sample the object to remove among those that are visible at the end of a prefix of at
    least a second before their first contact. Return its index; None if there is no such object."""
    stops = {k: _prefix_stop(scene, k) for k in range(len(scene.objects))}
    visible = visible_positions(scene)[1]
    eligible = [k for k, stop in stops.items() if stop is not None and visible[stop, k]]
    if not eligible:
        return None
    return int(named_rng(seed, "removed", scene.scene_id).choice(eligible))


def counterfactual_id(scene_id: str, removed: int) -> str:
    """Return the id of the counterfactual scene without object `removed`."""
    return f"{scene_id}{COUNTERFACTUAL}{removed}"


def _prefix_stop(scene: Scene, removed: int) -> int | None:
    """Return the last frame of the prefix: before the first contact of object `removed`, at most
    `LATEST_STOP`. None if the prefix would end before frame `FPS`."""
    contacts = [c.frame for c in scene.collisions if removed in c.objects]
    stop = min(LATEST_STOP, contacts[0] - 1) if contacts else -1
    return stop if stop >= FPS else None


def removal_displacement(scene: Scene, counterfactual: Scene, removed: int) -> np.ndarray:
    """Return the largest displacement of another object by the removal, (F,) px at 336 x 336.

    Only objects that are visible in at least one of the two scenes count.
    """
    positions, visible = (np.delete(a, removed, axis=1) for a in visible_positions(scene))
    other_positions, other_visible = visible_positions(counterfactual)
    distance = np.linalg.norm(positions - other_positions, axis=-1)
    return np.minimum(np.where(visible | other_visible, distance, 0.0).max(axis=-1), DIAGONAL)


def make_queries(cell: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the counterfactual queries, and count those that are dropped; see `fill_query_quota`.

    The removal displaces at least one other object in the target. The first hard negative is the
    same frame of the factual scene; the others are other frames of the counterfactual scene.
    """

    def queries_of(scene: Scene) -> Iterator[RetrievalQuery]:
        removed = removed_object(scene, cell.seed)
        if removed is None:
            return
        other, phrase = (
            counterfactual_id(scene.scene_id, removed),
            scene.objects[removed].noun_phrase,
        )
        displacement = removal_displacement(scene, cell.scene_of(other), removed)
        stop = _prefix_stop(scene, removed)
        for seconds in HORIZONS:
            target = stop + seconds * FPS
            if target < scene.frames and displacement[target] >= cell.min_displacement:
                yield RetrievalQuery(
                    query_id=f"counterfactual-{other}-{stop}-{target}",
                    split=scene.split,
                    pool="counterfactual",
                    builder=None,
                    anchor="intervention",
                    question=(
                        f"Had the {phrase} been absent, which frame would show the scene "
                        f"{spell_seconds(seconds)} after the observation ends?"
                    ),
                    scene_id=scene.scene_id,
                    prefix_start=0,
                    prefix_stop=stop,
                    target=FrameRef(other, target),
                    hard_negatives=(FrameRef(scene.scene_id, target),),
                    removed_object=phrase,
                )

    return fill_query_quota("counterfactual", cell, queries_of)
