"""The scenes of a benchmark, in two splits: simulated by Bullet, or read from a release.

For the first, `data.sim` samples bodies and simulates their motion. This module adds what the
camera sees of them, divides the scenes between the splits, and writes one file for each scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeVar

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.conf.schema import BenchmarkConfig, WorldConfig
from dynapix.data.oracle.events import group_contacts
from dynapix.data.oracle.interventions import counterfactual_id, removed_object
from dynapix.data.oracle.visibility import compute_visibility
from dynapix.data.parallel import Workers
from dynapix.data.records import SPEED_BOUNDS, SPLITS, Scene, SceneObject
from dynapix.data.seeded_order import named_rng
from dynapix.data.sim.camera import HEIGHT, WIDTH, Camera
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.physics import Body, shared_simulator
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sim.starts import Sample
from dynapix.data.sources.releases import list_release, read_release
from dynapix.data.store import save_scene, scene_path

SPLIT_BLOCK = 5
"""Number of consecutive scenes in a block; each block is divided between the splits."""
Element = TypeVar("Element")


def make_scenes(
    cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Write one file below `folder` for each scene of a benchmark that has none yet.

    Args:
        strict: Raise UserError at an invalid record of a release, instead of leaving it out.

    Returns:
        Scene ids by split, in a stable order, and the number of invalid records of a release.
    """
    if cfg.simulator != "bullet":
        videos = split_scenes(cfg, list_release(cfg))
        splits = {split: [*chain.from_iterable(own)] for split, own in videos.items()}
        scene_ids, left_out = read_release(cfg, splits, folder, workers, strict)
        return keep_test_scenes(cfg, scene_ids), left_out
    names = [scene_prefix(cfg) + f"s{cfg.seed}-{k:06d}" for k in range(cfg.scenes)]
    scene_ids = keep_test_scenes(cfg, split_scenes(cfg, names))
    split_of = {name: split for split, ids in scene_ids.items() for name in ids}
    jobs = {}
    for index, name in enumerate(names):
        if name in split_of:
            path = scene_path(folder, name)
            jobs[path] = partial(_simulate_one, cfg, index, split_of[name], path)
    workers.write_files(jobs, "simulating scenes", "scene")
    return scene_ids, {}


def scene_prefix(cfg: BenchmarkConfig) -> str:
    """Return what the ids of a benchmark's simulated scenes begin with: the name of the suite or of
    the world, or nothing in the standard world. So ids differ between worlds."""
    if cfg.item_recipe != "dynapix":
        return f"{cfg.suite}-"
    return "" if cfg.world.name == "clevrer" else f"{cfg.world.name}-"


def split_scenes(cfg: BenchmarkConfig, scenes: Sequence[Element]) -> dict[str, list[Element]]:
    """Divide scenes (or videos, as lists of clips) between the splits, in their order.

    Of every `SPLIT_BLOCK` consecutive scenes, random ones go to the test split, as many as
    `cfg.test_share` asks for. So the split of a scene depends on its index, the seed and the test
    share, and not on the number of scenes. A split that would be empty gets the last scene of the
    other one. Raises UserError if there is no other scene.
    """
    splits: dict[str, list[Element]] = {split: [] for split in SPLITS}
    for first in range(0, len(scenes), SPLIT_BLOCK):
        share = [round(cfg.test_share * n) for n in (first, first + SPLIT_BLOCK)]
        order = np.random.default_rng([cfg.seed, first // SPLIT_BLOCK]).permutation(SPLIT_BLOCK)
        test = set(order[: share[1] - share[0]].tolist())
        for k, scene in enumerate(scenes[first : first + SPLIT_BLOCK]):
            splits["test" if k in test else "train"].append(scene)
    if cfg.test_share < 1:
        for split, other in (SPLITS, SPLITS[::-1]):
            if splits[split]:
                continue
            if len(scenes) < 2:
                what = "video" if cfg.simulator == "tracks" else "scene"
                raise UserError(
                    f"benchmark.test_share={cfg.test_share} of a single {what} leaves no {split} "
                    f"{what}: use more {what}s, or set benchmark.test_share=1",
                    code="empty-split",
                )
            splits[split].append(splits[other].pop())
    return splits


def keep_test_scenes(cfg: BenchmarkConfig, scene_ids: dict[str, list[str]]) -> dict[str, list[str]]:
    """Return the ids with `cfg.test_scenes` random ones of the test split, or with all if that is
    None. Their order stays."""
    test = scene_ids["test"]
    order = named_rng(cfg.seed, "test scenes").permutation(len(test))
    chosen = {*order[: cfg.test_scenes].tolist()}
    return scene_ids | {"test": [name for k, name in enumerate(test) if k in chosen]}


def _simulate_one(cfg: BenchmarkConfig, index: int, split: str, path: Path) -> None:
    """Sample scene `index` of the world, and write it to `path`. If its split has counterfactual
    queries, one object is removed, and the scene without it is written beside it."""
    sample = sample_scene(cfg.world, cfg.seed, index)
    scene = record_scene(path.stem, split, sample, cfg.world)
    has_queries = getattr(cfg.retrieval.counterfactual, split)
    if has_queries and (removed := removed_object(scene, cfg.seed)) is not None:
        name = counterfactual_id(scene.scene_id, removed)
        other = simulate_without(name, split, sample.bodies, removed, cfg.world)
        save_scene(other, path.with_name(f"{name}.npz"))
    # This file is saved last, because it marks the job as done.
    save_scene(scene, path)


def simulate_without(
    name: str, split: str, bodies: list[Body], removed: int, world: WorldConfig
) -> Scene:
    """Return the scene that the same initial bodies give without body `removed`. Objects that it
    never affects, directly or through others, move bit-identically."""
    rest = bodies[:removed] + bodies[removed + 1 :]
    return record_scene(name, split, Sample(rest, shared_simulator().simulate(rest, world)), world)


def record_scene(name: str, split: str, sample: Sample, world: WorldConfig) -> Scene:
    """Return the oracle of a sampled scene: its motion with contacts and landings, and where and
    how much of each object the camera of the world sees."""
    scales = tuple(body.scale for body in sample.bodies)
    bounds = tuple(world.speed_bounds)
    return Scene(
        scene_id=name,
        split=split,
        objects=(objects := tuple(body.object for body in sample.bodies)),
        collisions=group_contacts(sample.motion.touching, world.physics.fps),
        image_size=(WIDTH, HEIGHT),
        fps=world.physics.fps,
        landings=sample.motion.landings,
        scenario=sample.scenario,
        scales=() if set(scales) == {1.0} else scales,
        speed_bounds=() if bounds == SPEED_BOUNDS else bounds,
        **oracle_arrays(objects, scales, sample.motion.states, world),
    )


def oracle_arrays(
    objects: tuple[SceneObject, ...],
    scales: Sequence[float],
    states: np.ndarray,
    world: WorldConfig,
) -> dict[str, np.ndarray]:
    """Return the arrays of a scene (`Scene.ARRAYS`) for the states (F, N, 13) of its objects."""
    camera = Camera.from_settings(world.camera)
    positions, quaternions, velocities, angular_velocities = np.split(states, [3, 7, 10], axis=-1)
    in_view, fraction = compute_visibility(
        objects, positions, quaternions, camera, scales, world_boxes(world)
    )
    floats = {
        "positions": positions,
        "quaternions": quaternions,
        "velocities": velocities,
        "angular_velocities": angular_velocities,
        "image_positions": camera.project(positions)[0],
        "visible_fraction": fraction,
    }
    arrays = {key: array.astype(np.float32) for key, array in floats.items()}
    return arrays | {"in_view": in_view}
