"""The six future-state builders: a prefix, a question, the target frame, and hard negatives.

Two builders are anchored in time and four in a collision. One second is 25 frames, and the clip
ends at its last frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs
from data.tracks.retrieval import queries

EVENTS_PER_SCENE = 3
"""Largest number of events of a scene that builder 3 uses."""
ONE_PER_SCENE = (4, 5, 6)
"""Builders that use one event of a scene (paper, retrieval construction)."""


@dataclass(frozen=True)
class FutureQuestion:
    """A question that a builder can ask about a scene: its anchor, prefix and target frame."""

    anchor: str
    question: str
    prefix: tuple[int, int]
    target: int


def _clip_end(scene: Scene) -> Iterator[FutureQuestion]:
    for seconds in (2, 3, 4):
        text = "Which frame shows the scene at the end of the clip, {} after the observation ends?"
        text = text.format(spell_seconds(5 - seconds))
        yield FutureQuestion("time", text, (0, seconds * FPS), scene.frames - 1)


def _clock(scene: Scene) -> Iterator[FutureQuestion]:
    for seconds in (1, 2, 3):
        text = f"Which frame shows the scene {spell_seconds(seconds)} after the observation ends?"
        yield FutureQuestion("time", text, (0, 2 * FPS), (2 + seconds) * FPS)


def _at_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene at the moment of the next collision?"
    for event in _events(scene)[:EVENTS_PER_SCENE]:
        for between in range(6):
            # At least one frame before the event, which is the target.
            stop = event - 1 - between
            if stop >= FPS and _is_next(scene, stop, event):
                yield FutureQuestion("event", text, (stop - FPS, stop), event)


def _after_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = (
        "The observation ends at a collision. Which frame shows the scene 1 second after that "
        "collision?"
    )
    for event in _events(scene):
        if event >= FPS and event + FPS < scene.frames:
            yield FutureQuestion("event", text, (event - FPS, event), event + FPS)


def _before_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene at the moment of the next collision?"
    for event in _events(scene):
        stop = event - FPS
        if stop >= FPS and _is_next(scene, stop, event):
            yield FutureQuestion("event", text, (stop - FPS, stop), event)


def _past_event(scene: Scene) -> Iterator[FutureQuestion]:
    text = "Which frame shows the scene half a second after the next collision?"
    for event in _events(scene):
        stop = event - FPS // 2
        if stop >= FPS and stop + FPS < scene.frames and _is_next(scene, stop, event):
            yield FutureQuestion("event", text, (stop - FPS, stop), stop + FPS)


def _events(scene: Scene) -> list[int]:
    """The frames of the scene's collisions, each once, in order."""
    return list(dict.fromkeys(c.frame for c in scene.collisions))


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
"""Each builder yields all questions that it can ask about a scene."""


def make_queries(builder: int, cell: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder, and count the dropped ones; see `queries.fill_quota`."""

    def make_query(
        scene: Scene, timing: FutureQuestion, rng: np.random.Generator
    ) -> RetrievalQuery | None:
        negatives = queries.pick_hard_negatives(
            scene, timing.target, cell.hard_negatives, cell.least, rng
        )
        if negatives is None:
            return None
        start, stop = timing.prefix
        return RetrievalQuery(
            query_id=f"future-{builder}-{scene.scene_id}-{start}-{stop}-{timing.target}",
            split=scene.split,
            pool="future",
            builder=builder,
            anchor=timing.anchor,
            question=timing.question,
            scene_id=scene.scene_id,
            prefix_start=start,
            prefix_stop=stop,
            target=FrameRef(scene.scene_id, timing.target),
            hard_negatives=tuple(FrameRef(scene.scene_id, frame) for frame in negatives),
        )

    once = builder in ONE_PER_SCENE
    return queries.fill_quota(str(builder), cell, BUILDERS[builder], make_query, once)
