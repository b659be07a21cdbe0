"""The six future-state builders: a prefix, a question and the target frame.

The questions of two builders state a time, and those of four refer to a collision. One second is
25 frames. The end of the clip is the last frame of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from data.records import FPS, FrameRef, RetrievalQuery, Scene
from data.tracks.quota import CellInputs
from data.tracks.retrieval.queries import fill_query_quota
from data.tracks.selection.time_items import spell_seconds
from data.world.events import collision_frames

EVENTS_PER_SCENE = 3
"""Maximum number of events of a scene that builder 3 uses."""
ONE_PER_SCENE = (4, 5, 6)
"""Builders that make at most one query per scene (paper, retrieval construction)."""
NEXT_COLLISION = "Which frame shows the scene at the moment of the next collision?"
AFTER_COLLISION = (
    "The observation ends at a collision. Which frame shows the scene 1 second after that "
    "collision?"
)
AFTER_NEXT_COLLISION = "Which frame shows the scene half a second after the next collision?"

TimedQuestion = tuple[str, int, int, int]
"""A question about a scene, the first and last frame of its prefix, and its target frame."""


def _clip_end(scene: Scene) -> Iterator[TimedQuestion]:
    for seconds in (2, 3, 4):
        text = "Which frame shows the scene at the end of the clip, {} after the observation ends?"
        yield text.format(spell_seconds(5 - seconds)), 0, seconds * FPS, scene.frames - 1


def _clock(scene: Scene) -> Iterator[TimedQuestion]:
    for seconds in (1, 2, 3):
        text = f"Which frame shows the scene {spell_seconds(seconds)} after the observation ends?"
        yield text, 0, 2 * FPS, (2 + seconds) * FPS


def _next_event(scene: Scene) -> Iterator[TimedQuestion]:
    for event in collision_frames(scene)[:EVENTS_PER_SCENE]:
        # The target is the event, and the prefix ends 1 to 6 frames before it.
        for stop in range(event - 1, event - 7, -1):
            if stop >= FPS and _is_next(scene, stop, event):
                yield NEXT_COLLISION, stop - FPS, stop, event


def _around_event(lead: int, text: str, scene: Scene) -> Iterator[TimedQuestion]:
    """Yield questions whose prefix ends `lead` frames before an event and 1 s before the target."""
    for event in collision_frames(scene):
        stop = event - lead
        if stop >= FPS and stop + FPS < scene.frames and (not lead or _is_next(scene, stop, event)):
            yield text, stop - FPS, stop, stop + FPS


def _is_next(scene: Scene, stop: int, event: int) -> bool:
    return min((c.frame for c in scene.collisions if c.frame > stop), default=None) == event


BUILDERS: dict[int, Callable[[Scene], Iterator[TimedQuestion]]] = {
    1: _clip_end,
    2: _clock,
    3: _next_event,
    4: partial(_around_event, 0, AFTER_COLLISION),
    5: partial(_around_event, FPS, NEXT_COLLISION),
    6: partial(_around_event, FPS // 2, AFTER_NEXT_COLLISION),
}
"""Each builder yields all questions that it can ask about a scene."""


def make_queries(builder: int, cell: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder, and count those dropped; see `fill_query_quota`."""

    def queries_of(scene: Scene) -> Iterator[RetrievalQuery]:
        for question, start, stop, target in BUILDERS[builder](scene):
            yield RetrievalQuery(
                query_id=f"future-{builder}-{scene.scene_id}-{start}-{stop}-{target}",
                split=scene.split,
                pool="future",
                builder=builder,
                anchor="time" if builder in (1, 2) else "event",
                question=question,
                scene_id=scene.scene_id,
                prefix_start=start,
                prefix_stop=stop,
                target=FrameRef(scene.scene_id, target),
            )

    return fill_query_quota(str(builder), cell, queries_of, builder in ONE_PER_SCENE)
