"""Counterfactual queries: the future of a scene had one object been absent.

The scene is simulated again from the same start without the object, and the target is a frame of
that scene. The prefix is the factual one and ends before the object's first contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs, named_rng
from data.tracks.retrieval import queries
from data.tracks.retrieval.future import spell_seconds
from data.world.displacement import DIAGONAL, cross_scene_displacement, on_screen_positions

LONGEST = 2 * FPS
"""Latest frame at which a prefix ends."""
HORIZONS = (1, 2, 3)
"""Seconds from the prefix's end to the target."""


@dataclass(frozen=True)
class CounterfactualTiming:
    """The last frame of a query's prefix, its target frame, and the seconds between them."""

    stop: int
    target: int
    seconds: int


def removed_object(scene: Scene, seed: int) -> int | None:
    """Sample the object to remove, among those whose first contact follows the prefix.

    The object must be on screen at the prefix's end, and the prefix at least a second long. None
    where no object qualifies.
    """
    eligible = [
        k
        for k in range(len(scene.objects))
        if (stop := _prefix_stop(scene, k)) is not None and on_screen_positions(scene)[1][stop, k]
    ]
    if not eligible:
        return None
    return int(named_rng(seed, "removed", scene.scene_id).choice(eligible))


def absent_id(scene_id: str, removed: int) -> str:
    """The id of a scene's counterfactual."""
    return f"{scene_id}-without-{removed}"


def _prefix_stop(scene: Scene, removed: int) -> int | None:
    contacts = [c.frame for c in scene.collisions if removed in c.objects]
    stop = min(LONGEST, contacts[0] - 1) if contacts else -1
    return stop if stop >= FPS else None


def counterfactual_timings(
    scene: Scene, absent: Scene, removed: int, least: float
) -> list[CounterfactualTiming]:
    """The timings at which the removal displaces another object by at least `least` px at 336."""
    stop = _prefix_stop(scene, removed)
    displacement = removal_displacement(scene, absent, removed)
    timings = [CounterfactualTiming(stop, stop + s * FPS, s) for s in HORIZONS]
    return [t for t in timings if t.target < scene.frames and displacement[t.target] >= least]


def removal_displacement(scene: Scene, absent: Scene, removed: int) -> np.ndarray:
    """(F,) the largest displacement of another object by the removal, px at 336 x 336.

    An object counts where its centre is on screen in either scene.
    """
    positions, on_screen = (np.delete(a, removed, axis=1) for a in on_screen_positions(scene))
    other_positions, other_on_screen = on_screen_positions(absent)
    distance = np.linalg.norm(positions - other_positions, axis=-1)
    return np.minimum(np.where(on_screen | other_on_screen, distance, 0.0).max(axis=-1), DIAGONAL)


def make_queries(cell: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the counterfactual queries, and count the dropped ones; see `queries.fill_quota`.

    The first hard negative is the factual scene at the target's frame; the others are wrong-time
    frames of the counterfactual scene.
    """

    def absent_of(scene: Scene) -> tuple[Scene, int] | None:
        removed = removed_object(scene, cell.seed)
        if removed is None:
            return None
        return cell.scene_of(absent_id(scene.scene_id, removed)), removed

    def timings_of(scene: Scene) -> list[CounterfactualTiming]:
        absent = absent_of(scene)
        return [] if absent is None else counterfactual_timings(scene, *absent, cell.least)

    def make_query(
        scene: Scene, timing: CounterfactualTiming, rng: np.random.Generator
    ) -> RetrievalQuery | None:
        absent, removed = absent_of(scene)
        count = cell.hard_negatives - 1
        wrong = queries.pick_hard_negatives(absent, timing.target, count, cell.least, rng)
        if wrong is None or any(
            cross_scene_displacement(scene, timing.target, absent, frame) < cell.least
            for frame in wrong
        ):
            return None
        phrase = scene.objects[removed].phrase
        return RetrievalQuery(
            query_id=f"counterfactual-{absent.scene_id}-{timing.stop}-{timing.target}",
            split=scene.split,
            pool="counterfactual",
            builder=None,
            anchor="intervention",
            question=(
                f"Had the {phrase} been absent, which frame would show the scene "
                f"{spell_seconds(timing.seconds)} after the observation ends?"
            ),
            scene_id=scene.scene_id,
            prefix_start=0,
            prefix_stop=timing.stop,
            target=FrameRef(absent.scene_id, timing.target),
            hard_negatives=(
                FrameRef(scene.scene_id, timing.target),
                *(FrameRef(absent.scene_id, frame) for frame in wrong),
            ),
            removed_object=phrase,
        )

    return queries.fill_quota("counterfactual", cell, timings_of, make_query)
