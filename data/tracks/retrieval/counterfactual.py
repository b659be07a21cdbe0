"""Counterfactual queries: what the scene would show had one object been absent.

The scene is simulated again without the object, from the same start, so that the target is a frame
of a scene of its own. The observation is the factual one, and ends before the object meets another
for the first time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from conf.schema import Quota
from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.retrieval import queries
from data.tracks.retrieval.future import spell_seconds
from data.tracks.selection.distractors import cell_rng
from data.world.displacement import DIAGONAL, cross_scene_displacement, on_screen_positions

LONGEST = 2 * FPS
"""Frames after which an observation ends at the latest."""
HORIZONS = (1, 2, 3)
"""Seconds after the observation that are asked for."""


@dataclass(frozen=True)
class CounterfactualTiming:
    """A query's end of the observation and its target, both frames, and the seconds between."""

    stop: int
    target: int
    seconds: int


def removed_object(scene: Scene, seed: int) -> int | None:
    """The object whose absence a scene is asked about: one that shows when the observation ends and
    meets another only after it, at least a second into the clip. None where there is none."""
    able = [
        k
        for k in range(len(scene.objects))
        if (stop := _stop(scene, k)) is not None and on_screen_positions(scene)[1][stop, k]
    ]
    if not able:
        return None
    return int(cell_rng(seed, "removed", scene.scene_id).choice(able))


def absent_id(scene_id: str, removed: int) -> str:
    """The id of a scene's counterfactual."""
    return f"{scene_id}-without-{removed}"


def _stop(scene: Scene, removed: int) -> int | None:
    met = [c.frame for c in scene.collisions if removed in c.objects]
    stop = min(LONGEST, met[0] - 1) if met else -1
    return stop if stop >= FPS else None


def counterfactual_timings(
    scene: Scene, absent: Scene, removed: int, least: float
) -> list[CounterfactualTiming]:
    """The moments at which the absence shows: some other object is at least `least` px (at 336)
    from where it is in the scene as it was."""
    stop = _stop(scene, removed)
    apart = removal_displacement(scene, absent, removed)
    asked = [CounterfactualTiming(stop, stop + seconds * FPS, seconds) for seconds in HORIZONS]
    return [m for m in asked if m.target < scene.frames and apart[m.target] >= least]


def removal_displacement(scene: Scene, absent: Scene, removed: int) -> np.ndarray:
    """(F,) the largest image displacement that the absence of `removed` makes to another object,
    px at 336 x 336; an object counts where its centre is on screen in either scene."""
    (places, shown), (other_places, other_shown) = (
        on_screen_positions(scene),
        on_screen_positions(absent),
    )
    places, shown = np.delete(places, removed, axis=1), np.delete(shown, removed, axis=1)
    apart = np.linalg.norm(places - other_places, axis=-1)
    return np.minimum(np.where(shown | other_shown, apart, 0.0).max(axis=-1), DIAGONAL)


def fill(
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    hard_negatives: int,
    least: float,
    seed: int,
) -> tuple[list[RetrievalQuery], int]:
    """Queries up to the quota, and how many moments were dropped; see `queries.fill`.

    The first hard negative is the scene as it was, at the target's own moment; the others are wrong
    times of the scene without the object.
    """

    def absent_of(scene: Scene) -> tuple[Scene, int] | None:
        removed = removed_object(scene, seed)
        return None if removed is None else (scene_of(absent_id(scene.scene_id, removed)), removed)

    def moments_of(scene: Scene) -> list[CounterfactualTiming]:
        absent = absent_of(scene)
        return [] if absent is None else counterfactual_timings(scene, *absent, least)

    def ask(
        scene: Scene, moment: CounterfactualTiming, rng: np.random.Generator
    ) -> RetrievalQuery | None:
        absent, removed = absent_of(scene)
        wrong = queries.wrong_times(absent, moment.target, hard_negatives - 1, least, rng)
        factual = (scene, moment.target)
        if wrong is None or any(
            cross_scene_displacement(*factual, absent, frame) < least for frame in wrong
        ):
            return None
        phrase = scene.objects[removed].phrase
        return RetrievalQuery(
            query_id=f"counterfactual-{absent.scene_id}-{moment.stop}-{moment.target}",
            split=scene.split,
            pool="counterfactual",
            builder=None,
            anchor="intervention",
            question=(
                f"Had the {phrase} been absent, which frame would show the scene "
                f"{spell_seconds(moment.seconds)} after the observation ends?"
            ),
            scene_id=scene.scene_id,
            prefix_start=0,
            prefix_stop=moment.stop,
            target=FrameRef(absent.scene_id, moment.target),
            hard_negatives=(
                FrameRef(scene.scene_id, moment.target),
                *(FrameRef(absent.scene_id, frame) for frame in wrong),
            ),
            removed_object=phrase,
        )

    return queries.fill("counterfactual", scene_ids, scene_of, quota, seed, moments_of, ask)
