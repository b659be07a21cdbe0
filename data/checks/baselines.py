"""Baselines: simple rules that answer selection items from the oracle alone, and a ranker that only
recognises the scene of a retrieval query.

`data.checks.shortcuts` has further rules, which compare pixels too. A high accuracy of a rule that
does not predict shows that items can be answered by a shortcut; `velocity` predicts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from dynapix.data.oracle.displacement import (
    MODEL_SIZE,
    cross_scene_displacement,
    distances_from,
)
from dynapix.data.oracle.extrapolation import extrapolate, project
from dynapix.data.records import (
    Candidate,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    original_scene_id,
)
from dynapix.data.store import Store


def constant_velocity_error(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Mean distance of the objects from their positions at constant velocity, px at 336 x 336.

    Positions are extrapolated from the last frame of the prefix to the target's moment, which
    questions of the event and window families do not state. The maximum is the image's diagonal,
    also for an object that the candidate's scene lacks. The result is NaN for releases whose scenes
    record no camera.
    """
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    seconds = (item.target_frame - item.prefix_stop) / scene.fps
    positions = extrapolate(scene, item.prefix_stop, seconds)
    expected = project(positions, scene, store.manifest["config"])
    if expected is None:
        return np.nan
    expected = expected * (MODEL_SIZE / np.array(scene.image_size))
    return float(distances_from(expected, scene, other, candidate.frame).mean())


def score_velocity(item: SelectionItem, store: Store) -> float:
    """Return the score (see `share_of_lowest`) of the candidate nearest to constant velocity."""
    costs = [constant_velocity_error(item, candidate, store) for candidate in item.candidates]
    return share_of_lowest(np.array(costs), item.answer)


def score_baselines(item: SelectionItem, store: Store) -> dict[str, float]:
    """Return the score (see `share_of_lowest`) of each baseline on an item."""
    frames = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
    last = store.scene(item.scene_id), item.prefix_stop
    distances = np.array(
        [[cross_scene_displacement(*one, *other) for other in frames] for one in (last, *frames)]
    )
    costs = {
        "nearest": distances[0],
        "odd": -distances[1:].sum(axis=0),
        "first": np.arange(len(frames)),
        "latest": np.array([-frame for _, frame in frames]),
    }
    scores = {name: share_of_lowest(each, item.answer) for name, each in costs.items()}
    return scores | {"velocity": score_velocity(item, store)}


def share_of_lowest(costs: np.ndarray, answer: int) -> float:
    """Return 1/m if the target is among the m candidates with the lowest cost, otherwise 0; NaN if
    the costs are NaN."""
    best = np.flatnonzero(costs == costs.min())
    return float(answer in best) / len(best) if len(best) else np.nan


def count_frames_of_scene(
    queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> np.ndarray:
    """Return for each query the number of frames of its scene in the database, (Q,). Frames of the
    scene's counterfactual count."""
    frames = Counter(original_scene_id(frame.scene_id) for frame in database)
    return np.array([frames[query.scene_id] for query in queries])


def score_scene_alone(
    queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> dict[str, float]:
    """Return the expected measures of a ranker that puts the frames of the target's scene first, in
    a random order: recalls, the mean reciprocal rank and the median of the mean ranks."""
    counts = count_frames_of_scene(queries, database)
    harmonic = np.cumsum(1 / np.arange(1, counts.max() + 1))
    recalls = {f"recall@{k}": float(np.minimum(k / counts, 1).mean()) for k in (1, 10, 50)}
    return recalls | {
        "mrr": float((harmonic[counts - 1] / counts).mean()),
        "median rank": float(np.median((counts + 1) / 2)),
        "frames per scene": float(counts.mean()),
    }
