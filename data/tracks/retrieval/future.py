"""The six future-state builders: a prefix, a question, the target frame, and hard negatives.

Two are anchored in time and four in a collision (`anchor`). Times convert to frames at 25 a second
and the clip's end is its last frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from conf.schema import Quota
from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.retrieval import queries

EVENTS_A_SCENE = 3
"""Events of a scene that builder 3 uses at most."""
ONE_A_SCENE = (4, 5, 6)
"""Builders that ask for one event of a scene (paper, retrieval construction)."""


@dataclass(frozen=True)
class FutureQuestion:
    """What a builder asks of a scene: an observation, a question, and the frame that answers."""

    anchor: str
    question: str
    prefix: tuple[int, int]
    target: int


def _clip_end(scene: Scene) -> Iterator[FutureQuestion]:
    for seconds in (2, 3, 4):
        text = "Which frame shows the scene at the end of the clip, {} after the observation ends?"
        left = spell_seconds(5 - seconds)
        yield FutureQuestion("time", text.format(left), (0, seconds * FPS), scene.frames - 1)


def _clock(scene: Scene) -> Iterator[FutureQuestion]:
    for seconds in (1, 2, 3):
        text = f"Which frame shows the scene {spell_seconds(seconds)} after the observation ends?"
        yield FutureQuestion("time", text, (0, 2 * FPS), (2 + seconds) * FPS)


def _at_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene at the moment of the next collision?"
    for event in list(dict.fromkeys(c.frame for c in scene.collisions))[:EVENTS_A_SCENE]:
        for early in range(6):
            # So many frames lie between: the event's own would show the target.
            stop = event - 1 - early
            if stop >= FPS and _is_next(scene, stop, event):
                yield FutureQuestion("event", text, (stop - FPS, stop), event)


def _after_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = (
        "The observation ends at a collision. Which frame shows the scene 1 second after that "
        "collision?"
    )
    for event in {c.frame: None for c in scene.collisions}:
        if event >= FPS and event + FPS < scene.frames:
            yield FutureQuestion("event", text, (event - FPS, event), event + FPS)


def _before_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene at the moment of the next collision?"
    for event in {c.frame: None for c in scene.collisions}:
        stop = event - FPS
        if stop >= FPS and _is_next(scene, stop, event):
            yield FutureQuestion("event", text, (stop - FPS, stop), event)


def _past_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene half a second after the next collision?"
    for event in {c.frame: None for c in scene.collisions}:
        stop = event - FPS // 2
        if stop >= FPS and stop + FPS < scene.frames and _is_next(scene, stop, event):
            yield FutureQuestion("event", text, (stop - FPS, stop), stop + FPS)


def _is_next(scene: Scene, stop: int, event: int) -> bool:
    return min((c.frame for c in scene.collisions if c.frame > stop), default=None) == event


def spell_seconds(count: int) -> str:
    return "1 second" if count == 1 else f"{count} seconds"


BUILDERS: dict[int, Callable[[Scene], Iterator[FutureQuestion]]] = {
    1: _clip_end,
    2: _clock,
    3: _at_event,
    4: _after_event,
    5: _before_event,
    6: _past_event,
}
"""Each gives every moment of a scene that it can ask for."""


def fill(
    builder: int,
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
    quota: Quota,
    hard_negatives: int,
    least: float,
    seed: int,
) -> tuple[list[RetrievalQuery], int]:
    """Queries of one builder up to its quota, and how many moments were dropped; see
    `queries.fill`."""

    def ask(
        scene: Scene, moment: FutureQuestion, rng: np.random.Generator
    ) -> RetrievalQuery | None:
        negatives = queries.wrong_times(scene, moment.target, hard_negatives, least, rng)
        if negatives is None:
            return None
        start, stop = moment.prefix
        return RetrievalQuery(
            query_id=f"future-{builder}-{scene.scene_id}-{start}-{stop}-{moment.target}",
            split=scene.split,
            pool="future",
            builder=builder,
            anchor=moment.anchor,
            question=moment.question,
            scene_id=scene.scene_id,
            prefix_start=start,
            prefix_stop=stop,
            target=FrameRef(scene.scene_id, moment.target),
            hard_negatives=tuple(FrameRef(scene.scene_id, frame) for frame in negatives),
        )

    def moments(scene: Scene) -> list[FutureQuestion]:
        return list(BUILDERS[builder](scene))

    once = builder in ONE_A_SCENE
    return queries.fill(str(builder), scene_ids, scene_of, quota, seed, moments, ask, once)
