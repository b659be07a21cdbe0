"""Counterfactual queries: the future of a scene had one object been absent.

The scene is simulated again from the same start without the object, and the target is a frame of
that scene. The prefix is the factual one and ends before the object's first contact.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs, named_rng
from data.tracks.retrieval.queries import fill_query_quota
from data.tracks.selection.time import spell_seconds
from data.world.displacement import DIAGONAL, on_screen_positions

LATEST_STOP = 2 * FPS
"""Latest frame at which a prefix ends."""
HORIZONS = (1, 2, 3)
"""Seconds from the prefix's end to the target."""


def removed_object(scene: Scene, seed: int) -> int | None:
    """Sample the object to remove, among those whose first contact follows a prefix of at least a
    second and that are on screen at its end. None where there is no such object."""
    stops = {k: _prefix_stop(scene, k) for k in range(len(scene.objects))}
    on_screen = on_screen_positions(scene)[1]
    eligible = [k for k, stop in stops.items() if stop is not None and on_screen[stop, k]]
    if not eligible:
        return None
    return int(named_rng(seed, "removed", scene.scene_id).choice(eligible))


def absent_id(scene_id: str, removed: int) -> str:
    """The id of a scene's counterfactual."""
    return f"{scene_id}-without-{removed}"


def _prefix_stop(scene: Scene, removed: int) -> int | None:
    contacts = [c.frame for c in scene.collisions if removed in c.objects]
    stop = min(LATEST_STOP, contacts[0] - 1) if contacts else -1
    return stop if stop >= FPS else None


def removal_displacement(scene: Scene, absent: Scene, removed: int) -> np.ndarray:
    """(F,) the largest displacement of another object by the removal, px at 336 x 336.

    An object counts where its centre is on screen in either scene.
    """
    positions, on_screen = (np.delete(a, removed, axis=1) for a in on_screen_positions(scene))
    other_positions, other_on_screen = on_screen_positions(absent)
    distance = np.linalg.norm(positions - other_positions, axis=-1)
    return np.minimum(np.where(on_screen | other_on_screen, distance, 0.0).max(axis=-1), DIAGONAL)


def make_queries(cell: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the counterfactual queries, and count the dropped ones; see `fill_query_quota`.

    The removal displaces another object in the target. The first hard negative is the factual scene
    at the target's frame; the others are wrong-time frames of the counterfactual scene.
    """

    def queries_of(scene: Scene) -> Iterator[RetrievalQuery]:
        removed = removed_object(scene, cell.seed)
        if removed is None:
            return
        absent, phrase = absent_id(scene.scene_id, removed), scene.objects[removed].noun_phrase
        displacement = removal_displacement(scene, cell.scene_of(absent), removed)
        stop = _prefix_stop(scene, removed)
        for seconds in HORIZONS:
            target = stop + seconds * FPS
            if target < scene.frames and displacement[target] >= cell.min_displacement:
                yield RetrievalQuery(
                    query_id=f"counterfactual-{absent}-{stop}-{target}",
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
                    target=FrameRef(absent, target),
                    hard_negatives=(FrameRef(scene.scene_id, target),),
                    removed_object=phrase,
                )

    return fill_query_quota("counterfactual", cell, queries_of)
