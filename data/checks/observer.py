"""The observer's curve: how exact eyes must be to answer the items of a simulated benchmark.

An observer sees the objects in the frames of the prefix with an error of s px, fits a position and
a velocity to each, and chooses the candidate nearest to what it predicts for the target's moment.
One observer simulates the scene from there, the other one extrapolates at constant velocity. Both
know the moment; the one that simulates also knows masses, friction and orientations.

The observer's motion model is exact, so that its fit is that of the errors alone: a line through
the errors of the frames in which an object is visible, since its last contact in the prefix. An
object with fewer than two such frames is known exactly. Objects that no frame of the prefix shows
take part in the simulation, but their places are not compared.

From the exact state, the observer that simulates is right. It starts at the last frame of the
prefix in which no objects touch: Bullet keeps contacts from step to step, a stored state lacks
them, and a simulation from within a contact may stray.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from dynapix.conf.errors import UserError
from dynapix.conf.files import is_writable, write_bytes
from dynapix.conf.runs import lock_file
from dynapix.conf.schema import WorldConfig
from dynapix.conf.schema.settings import from_dict
from dynapix.data.items.futures.simulation import scene_states, simulate_futures
from dynapix.data.oracle.displacement import MODEL_SIZE, distances_from, visible_positions
from dynapix.data.oracle.events import touching_pairs
from dynapix.data.parallel import Workers, batched
from dynapix.data.records import Scene, SelectionItem, sample_prefix_frames
from dynapix.data.seeded_order import named_rng
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.physics import Branch
from dynapix.data.store import Store

ERRORS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Standard deviations of an observer's errors in each direction of the image, px at 336 x 336."""
DRAWS = 8
"""Number of draws of the errors for each item."""
OBSERVERS = SIMULATES, EXTRAPOLATES = "simulates", "extrapolates"
OBSERVER_FOLDER = "observer-2"
"""Folder of a store with the results. Its number rises when the results would change."""
CHUNK = 25
"""Number of items in one file of results."""


def observe_benchmark(store: Store, split: str, workers: Workers) -> dict[str, pd.DataFrame]:
    """Return the results of the observers on the items of a split. They are computed once and kept
    in the store, in small files, so that a killed run goes on where it was.

    Returns:
        By observer (simulates, extrapolates): the share of the draws in which it chooses the
        target, with a row for each item id and a column for each error, 0 and `ERRORS`. Without an
        error, there is one draw.

    Raises:
        UserError: The scenes of the benchmark were not simulated by Bullet, the split has no items,
            or the store cannot be written and has no results.
    """
    if (results := load_observers(store, split)) is not None:
        return results
    if store.manifest["config"]["simulator"] != "bullet":
        raise UserError(
            f"{store.folder}: its scenes are those of a release, which cannot be simulated again, "
            "so there is no observer: choose a benchmark with benchmark.simulator=bullet",
            code="no-simulation",
        )
    chunks, folder = _list_chunks(store, split), store.folder / OBSERVER_FOLDER
    if not chunks:
        raise UserError(
            f"{store.folder} has no selection items in the split {split}, so there is nothing to "
            "observe: choose a benchmark with quotas in benchmark.selection",
            code="empty-split",
        )
    if not is_writable(folder):
        raise UserError(
            f"{folder} cannot be written, so the results of observers cannot be kept: copy the "
            "benchmark to a folder that you may write",
            code="read-only",
        )
    with lock_file(folder / ".lock", f"observers of {store.folder} run in another process", True):
        jobs = {path: partial(_observe_items, store, own, path) for path, own in chunks.items()}
        sizes = {path: len(own) for path, own in chunks.items()}
        workers.write_files(jobs, "simulating observers", "item", sizes)
    return load_observers(store, split)


def load_observers(store: Store, split: str) -> dict[str, pd.DataFrame] | None:
    """Return the results that `observe_benchmark` has kept; None unless it has finished."""
    paths = [*_list_chunks(store, split)]
    if not paths or not all(path.exists() for path in paths):
        return None
    parts = [json.loads(path.read_bytes()) for path in paths]
    columns = [0.0, *ERRORS]
    return {
        name: pd.concat(pd.DataFrame.from_dict(p[name], "index", columns=columns) for p in parts)
        for name in OBSERVERS
    }


def _list_chunks(store: Store, split: str) -> dict[Path, list[SelectionItem]]:
    """Return the items of each file of results."""
    folder = store.folder / OBSERVER_FOLDER
    parts = batched(store.selection(split), CHUNK)
    return {folder / f"{split}-{k}.json": own for k, own in enumerate(parts)}


def _observe_items(store: Store, items: Sequence[SelectionItem], path: Path) -> None:
    rows: dict[str, dict[str, list[float]]] = {name: {} for name in OBSERVERS}
    for item in items:
        rng = named_rng(store.manifest["seed"], "observer", item.item_id)
        for observer, right in observe_item(item, store, ERRORS, DRAWS, rng).items():
            rows[observer][item.item_id] = right.mean(axis=1).tolist()
    write_bytes(path, json.dumps(rows).encode())


def observe_item(
    item: SelectionItem,
    store: Store,
    errors: Sequence[float],
    draws: int,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Return for each observer its credit in each draw, (1 + E, draws): without an error, where all
    draws are the same, and with each of the errors. All errors share the same draws, scaled. The
    credit is 1 for the target, and 1/m if m candidates with the target among them tie."""
    scene, stop = store.scene(item.scene_id), item.prefix_stop
    config = store.manifest["config"]
    world: WorldConfig = from_dict(WorldConfig, config["world"])
    camera = Camera.from_settings(world.camera)
    shown = sample_prefix_frames(item.prefix_start, stop, config["prefix_frames"])
    unit = np.array([sample_fit_errors(scene, shown, rng) for _ in range(draws)])
    scaled = np.concatenate([np.zeros((1, *unit.shape[1:])), *(e * unit for e in errors)])
    exact = scene_states(scene).astype(float)
    states = exact[stop] + ground_errors(scene, stop, scaled, camera)
    apart = last_frame_apart(scene, stop)
    motions = [
        *simulate_futures(scene, apart, item.target_frame, [Branch(exact[apart])], world),
        *simulate_futures(scene, stop, item.target_frame, [*map(Branch, states[1:])], world),
    ]
    seconds = (item.target_frame - stop) / scene.fps
    predictions = {
        SIMULATES: np.stack([motion.positions[-1] for motion in motions]),
        EXTRAPOLATES: states[..., :3] + seconds * states[..., 7:10],
    }
    known = visible_positions(scene)[1][item.prefix_start : stop + 1].any(axis=0)
    right = {}
    for observer, positions in predictions.items():
        image = camera.project(positions)[0] * (MODEL_SIZE / np.array(scene.image_size))
        distances = candidate_distances(item, store, image, known)
        nearest = distances == distances.min(axis=1, keepdims=True)
        credit = nearest[:, item.answer] / nearest.sum(axis=1)
        right[observer] = np.append(credit[:1].repeat(draws), credit[1:]).reshape(-1, draws)
    return right


def last_frame_apart(scene: Scene, stop: int) -> int:
    """Return the last frame up to `stop` in which no objects touch, or the scene's first frame."""
    frames = range(stop, 0, -1)
    return next((frame for frame in frames if not touching_pairs(scene, frame, frame)), 0)


def sample_fit_errors(scene: Scene, shown: Sequence[int], rng: np.random.Generator) -> np.ndarray:
    """Sample the errors of the fitted positions and velocities of the objects at the last of the
    frames shown, (N, 2, 2): px, and px per second, if every observed position has an error of 1 px
    in each direction."""
    visible, last = visible_positions(scene)[1], shown[-1]
    fitted = np.zeros((len(scene.objects), 2, 2))
    for k in range(len(scene.objects)):
        contacts = [
            min(c.end, last) for c in scene.collisions if k in c.objects and c.frame <= last
        ]
        seen = [frame for frame in shown if visible[frame, k]]
        since = [frame for frame in seen if frame >= max(contacts, default=0)]
        frames = since if len(since) >= 2 else seen
        if len(frames) >= 2:
            times = (np.array(frames) - last) / scene.fps
            line = np.stack([np.ones_like(times), times], axis=-1)
            fitted[k] = np.linalg.lstsq(line, rng.normal(size=(len(frames), 2)), rcond=None)[0]
    return fitted


def ground_errors(scene: Scene, frame: int, errors: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the errors of states (K, N, 13) that correspond to errors (K, N, 2, 2) of positions
    and velocities in the image, px at 336 x 336, for objects whose heights are known."""
    positions, step = scene.positions[frame].astype(float), 1e-3
    scale = MODEL_SIZE / np.array(scene.image_size)
    moved = [camera.project(positions + step * np.eye(3)[axis])[0] for axis in (0, 1)]
    base = camera.project(positions)[0]
    jacobian = np.stack([(each - base) * scale / step for each in moved], axis=-1)
    ground = np.einsum("nij,kntj->knti", np.linalg.pinv(jacobian), errors)
    states = np.zeros((len(errors), len(positions), 13))
    states[..., 0:2], states[..., 7:9] = ground[:, :, 0], ground[:, :, 1]
    return states


def candidate_distances(
    item: SelectionItem, store: Store, predicted: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Return the sum of the distances of the known objects between K predictions (K, N, 2) and each
    of the four candidates, (K, 4) px at 336 x 336; the image's diagonal for a missing object. The
    candidates tie where no object is known."""
    scene = store.scene(item.scene_id)
    distances = [
        distances_from(predicted, scene, store.scene(c.scene_id), c.frame)[:, known].sum(axis=-1)
        for c in item.candidates
    ]
    return np.stack(distances, axis=-1)
