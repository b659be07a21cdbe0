"""Baselines: simple rules that answer selection items from the oracle, and a ranker that only
recognises the scene of a retrieval query.

A high accuracy of a rule that does not predict shows that items can be answered by a shortcut;
`velocity` predicts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from data.oracle.displacement import DIAGONAL, MODEL_SIZE, cross_scene_displacement
from data.records import Candidate, FrameRef, RetrievalQuery, SelectionItem
from data.sim.camera import Camera
from data.store import Store


def displacement_from_prefix(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Displacement between the last frame of the prefix and the candidate."""
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    return cross_scene_displacement(scene, item.prefix_stop, other, candidate.frame)


def displacement_from_others(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Sum of the displacements between the candidate and the other candidates."""
    scene = store.scene(candidate.scene_id)
    return sum(
        cross_scene_displacement(scene, candidate.frame, store.scene(c.scene_id), c.frame)
        for c in item.candidates
    )


def constant_velocity_error(item: SelectionItem, candidate: Candidate, store: Store) -> float:
    """Mean distance of the objects from their positions at constant velocity, px at 336 x 336.

    Positions are extrapolated from the last frame of the prefix to the target's moment, which
    questions of the event and window families do not state. An object that the candidate's scene
    lacks has the image's diagonal as its distance, which is also the maximum. The result is NaN for
    releases of simulators whose cameras the scenes do not record.
    """
    config = store.manifest["config"]
    if config["simulator"] in ("movi_a", "physion"):
        return np.nan
    scene, other = store.scene(item.scene_id), store.scene(candidate.scene_id)
    seconds = (item.target_frame - item.prefix_stop) / scene.fps
    positions = scene.positions[item.prefix_stop] + seconds * scene.velocities[item.prefix_stop]
    if config["simulator"] == "tracks":
        # Positions are those of the image plane, in heights of the image with y up.
        expected = (positions[:, :2] * [1, -1] + [0, 1]) * scene.image_size[1]
    else:
        expected, _ = Camera.from_settings(config["world"]["camera"]).project(positions)
    actual = dict(zip(other.object_keys, other.image_positions[candidate.frame], strict=True))
    scale = MODEL_SIZE / np.array(scene.image_size)
    distances = [
        np.linalg.norm((expected[k] - actual[key]) * scale) if key in actual else DIAGONAL
        for k, key in enumerate(scene.object_keys)
    ]
    return float(np.minimum(distances, DIAGONAL).mean())


def baseline_costs(item: SelectionItem, store: Store) -> dict[str, np.ndarray]:
    """Return each baseline's costs of the candidates, (4,), by the names in `BASELINES`."""

    def costs(function: Callable[[SelectionItem, Candidate, Store], float]) -> np.ndarray:
        return np.array([function(item, candidate, store) for candidate in item.candidates])

    from_prefix, from_others = costs(displacement_from_prefix), costs(displacement_from_others)
    frames = np.array([candidate.frame for candidate in item.candidates])
    return {
        "nearest": from_prefix,
        "farthest": -from_prefix,
        "first": np.arange(len(frames)),
        "latest": -frames,
        "odd": -from_others,
        "typical": from_others,
        "velocity": costs(constant_velocity_error),
    }


BASELINES = ("nearest", "farthest", "first", "latest", "odd", "typical", "velocity")
"""Names of the baselines. A baseline chooses the candidate with the lowest cost."""


def score_baselines(item: SelectionItem, store: Store) -> dict[str, float]:
    """Return each baseline's score on an item: 1/m if the target is among the m candidates with the
    lowest cost, otherwise 0; NaN if the baseline cannot be computed for the simulator."""
    scores = {}
    for name, costs in baseline_costs(item, store).items():
        best = np.flatnonzero(costs == costs.min())
        scores[name] = float(item.answer in best) / len(best) if len(best) else np.nan
    return scores


def count_frames_of_scene(
    queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> np.ndarray:
    """Return for each query the number of frames of its target's scene in the database, (Q,)."""
    frames = Counter(frame.scene_id for frame in database)
    return np.array([frames[query.target.scene_id] for query in queries])


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
