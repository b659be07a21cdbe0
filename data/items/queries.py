"""Makes retrieval queries: a prefix, a question and the target frame, with hard negatives.

Six builders make future-state queries. The questions of two builders state a time, and those of
four, of the suite `dynapix` only, refer to a collision. One second is as many frames as the scene
has per second, 25 in that suite. The end of the clip is the last frame of the scene.

Counterfactual queries ask where an object would be had another one been absent. The scene is
simulated again from the same start without that object; the target is a frame of this
counterfactual scene. The prefix shows the factual scene and ends before the object's first contact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from dynapix.conf.schema.benchmark import COUNTERFACTUAL_SECONDS, QUERIES_PER_SCENE
from dynapix.data.items.pickers import CellInputs
from dynapix.data.items.recipes import spell_seconds
from dynapix.data.oracle.displacement import (
    cross_scene_displacement,
    frame_displacements,
    visible_positions,
)
from dynapix.data.oracle.events import collision_frames, is_next
from dynapix.data.oracle.interventions import (
    counterfactual_id,
    last_factual_frame,
    removal_displacements,
    removed_object,
)
from dynapix.data.records import FPS, SPLITS, FrameRef, RetrievalQuery, Scene
from dynapix.data.seeded_order import named_rng, round_robin

OBSERVED = 2
"""Number of seconds that builder 2 observes, and minimum number for builder 1."""
REST = 0.1
"""Share of a second by which the end of a clip may be later than builder 1 states."""
LEAD = 5
"""Number of frames from the end of a prefix of builder 3 to the event."""
MIN_OBSERVED = 12
"""Minimum number of frames of a prefix of builder 3: the number that a model is shown."""
OFFSETS = (16, 32, 48)
"""Preferred offsets of hard negatives from the target, in frames on either side."""
DENSE_STEP = 4
"""Step in frames of the grid from which hard negatives are chosen if `OFFSETS` do not suffice."""
NEXT_COLLISION = "Which frame shows the scene at the moment of the next collision?"
AFTER_COLLISION = (
    "The observation ends at a collision. Which frame shows the scene 1 second after that "
    "collision?"
)
AFTER_NEXT_COLLISION = "Which frame shows the scene half a second after the next collision?"

TimedQuestion = tuple[str, int, int, int]
"""A question about a scene, the first and last frame of its prefix, and its target frame."""


def _clip_end(scene: Scene) -> Iterator[TimedQuestion]:
    second = round(scene.fps)
    length, rest = divmod(scene.frames - 1, second)
    # The 2 frames by which CLEVRER's scenes exceed 5 s are too few to matter. A longer rest is
    # observed, so that the stated seconds are true.
    rest = rest if rest > REST * second else 0
    for ahead in (3, 2, 1):
        if length - ahead >= OBSERVED:
            text = (
                "Which frame shows the scene at the end of the clip, "
                f"{spell_seconds(ahead)} after the observation ends?"
            )
            yield text, 0, rest + (length - ahead) * second, scene.frames - 1


def _clock(scene: Scene) -> Iterator[TimedQuestion]:
    second = round(scene.fps)
    for ahead in (1, 2, 3):
        target = (OBSERVED + ahead) * second
        if target < scene.frames:
            text = f"Which frame shows the scene {spell_seconds(ahead)} after the observation ends?"
            yield text, 0, OBSERVED * second, target


def _next_event(scene: Scene) -> Iterator[TimedQuestion]:
    events = [e for e in collision_frames(scene) if is_next(scene, e - LEAD, e)]
    for event in [e for e in events if e - LEAD + 1 >= MIN_OBSERVED][: QUERIES_PER_SCENE["3"]]:
        yield NEXT_COLLISION, 0, event - LEAD, event


def _around_event(lead: int, text: str, scene: Scene) -> Iterator[TimedQuestion]:
    """Yield questions whose prefix ends `lead` frames before an event and 1 s before the target."""
    for event in collision_frames(scene):
        stop = event - lead
        if stop >= FPS and stop + FPS < scene.frames and (not lead or is_next(scene, stop, event)):
            yield text, stop - FPS, stop, stop + FPS


BUILDERS: dict[int, Callable[[Scene], Iterator[TimedQuestion]]] = {
    1: _clip_end,
    2: _clock,
    3: _next_event,
    4: partial(_around_event, 0, AFTER_COLLISION),
    5: partial(_around_event, FPS, NEXT_COLLISION),
    6: partial(_around_event, FPS // 2, AFTER_NEXT_COLLISION),
}
"""Each builder yields all questions that it can ask about a scene."""


def make_future_queries(builder: int, inputs: CellInputs) -> tuple[list[RetrievalQuery], int]:
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

    return fill_query_quota(str(builder), inputs, queries_of, QUERIES_PER_SCENE[str(builder)] == 1)


def make_counterfactual_queries(inputs: CellInputs) -> tuple[list[RetrievalQuery], int]:
    """Make the counterfactual queries, and count those dropped; see `fill_query_quota`.

    A query names the removed object and the object that its absence displaces most, among those
    that are visible in the prefix and in the target frame. The first hard negative is the same
    frame of the factual scene.
    """

    def queries_of(scene: Scene) -> Iterator[RetrievalQuery]:
        removed = removed_object(scene, inputs.seed)
        if removed is None:
            return
        stop = last_factual_frame(scene, removed)
        other = counterfactual_id(scene.scene_id, removed)
        shifts = removal_displacements(scene, inputs.scene_of(other), removed)
        # The question can only name an object that the observation shows.
        shifts[:, ~visible_positions(scene)[1][: stop + 1].any(axis=0)] = 0.0
        for seconds in COUNTERFACTUAL_SECONDS:
            target = stop + int(seconds * FPS)
            if target >= scene.frames or shifts[target].max() < inputs.min_displacement:
                continue
            most = int(shifts[target].argmax())
            absent, asked = (scene.objects[k].noun_phrase for k in (removed, most))
            yield RetrievalQuery(
                query_id=f"counterfactual-{other}-{stop}-{target}",
                split=scene.split,
                pool="counterfactual",
                builder=None,
                anchor="intervention",
                question=(
                    f"Had the {absent} been absent, where would the {asked} be "
                    f"{spell_seconds(seconds)} after the observation ends? Which frame shows it?"
                ),
                scene_id=scene.scene_id,
                prefix_start=0,
                prefix_stop=stop,
                target=FrameRef(other, target),
                hard_negatives=(FrameRef(scene.scene_id, target),),
                removed_object=absent,
                asked_object=asked,
            )

    return fill_query_quota("counterfactual", inputs, queries_of)


def fill_query_quota(
    builder: str,
    inputs: CellInputs,
    queries_of: Callable[[Scene], Iterable[RetrievalQuery]],
    one_per_scene: bool = False,
) -> tuple[list[RetrievalQuery], int]:
    """Make the queries of one builder up to its quota in each split. Scenes take turns in a seeded
    order: each gives one query before any gives a second one.

    Args:
        queries_of: Returns all queries about a scene, for `add_hard_negatives`.
        one_per_scene: Whether a scene gives at most one query.

    Returns:
        The queries, and the number of queries that `add_hard_negatives` dropped.
    """

    def attempts(
        queries: list[RetrievalQuery], rng: np.random.Generator
    ) -> Iterator[RetrievalQuery | None]:
        for query in queries:
            yield (completed := add_hard_negatives(query, inputs, rng))
            if completed is not None and one_per_scene:
                return

    made, dropped = [], 0
    for split in SPLITS:
        rng = named_rng(inputs.seed, "retrieval", builder, split)
        scene_ids, wanted = inputs.scene_ids[split], getattr(inputs.quota, split) + len(made)
        queues = []
        for index in rng.permutation(len(scene_ids)) if wanted > len(made) else ():
            queries = list(queries_of(inputs.scene_of(scene_ids[index])))
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
    query: RetrievalQuery, inputs: CellInputs, rng: np.random.Generator
) -> RetrievalQuery | None:
    """Complete a query's hard negatives with other frames of its target's scene.

    The added frames differ from the target, from each other and from the hard negatives that the
    query already has by at least `inputs.min_displacement`. Frames of the prefix are included: the
    database contains them too, and a retriever has to rank them below the target. Return None if
    there are too few such frames.
    """
    scene, target = inputs.scene_of(query.target.scene_id), query.target.frame
    displacements = frame_displacements(scene)
    preferred = [target + side * offset for offset in OFFSETS for side in (-1, 1)]
    dense = list(range(target % DENSE_STEP, scene.frames, DENSE_STEP))
    count = 1 + inputs.hard_negatives - len(query.hard_negatives)
    chosen = [target]
    for frame in [*rng.permutation(preferred), *rng.permutation(dense)]:
        if len(chosen) == count:
            break
        is_in_scene = 0 <= frame < scene.frames
        if is_in_scene and displacements[frame, chosen].min() >= inputs.min_displacement:
            chosen.append(int(frame))
    wrong = chosen[1:]
    if len(chosen) < count or any(
        cross_scene_displacement(inputs.scene_of(given.scene_id), given.frame, scene, frame)
        < inputs.min_displacement
        for given in query.hard_negatives
        for frame in wrong
    ):
        return None
    negatives = (FrameRef(scene.scene_id, frame) for frame in wrong)
    return replace(query, hard_negatives=(*query.hard_negatives, *negatives))
