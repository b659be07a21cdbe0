"""The scenes of a benchmark: which split each is in, and the simulation of those that are not there
yet."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np

from conf.errors import UserError
from conf.schema import BenchmarkConfig
from data.bullet import record, sample_bodies, scene_id, without
from data.parallel import Workers
from data.records import SPLITS
from data.retrieval import counterfactual
from data.store import save_scene, scene_path

SPLIT_BLOCK = 5
"""Consecutive scenes that are split together."""


def split_scenes(cfg: BenchmarkConfig) -> dict[str, list[str]]:
    """Scene ids of each split, in order of index: of every few scenes a seeded share is for
    testing.

    A scene's split follows from the seed and its index alone, so that a larger benchmark never
    trains on what a smaller one tests: both simulate the same scenes.

    Raises:
        UserError: a split would be empty.
    """
    ids: dict[str, list[str]] = {split: [] for split in SPLITS}
    for block in range(math.ceil(cfg.scenes / SPLIT_BLOCK)):
        first = block * SPLIT_BLOCK
        share = [round(cfg.test_share * n) for n in (first, first + SPLIT_BLOCK)]
        order = np.random.default_rng([cfg.seed, block]).permutation(SPLIT_BLOCK)
        test = set(order[: share[1] - share[0]].tolist())
        for k in range(min(SPLIT_BLOCK, cfg.scenes - first)):
            ids["test" if k in test else "train"].append(scene_id(cfg.seed, first + k))
    for split in SPLITS:
        if not ids[split]:
            raise UserError(
                f"benchmark.scenes={cfg.scenes} with benchmark.test_share={cfg.test_share} leaves "
                f"no scene to {split} on: raise benchmark.scenes"
            )
    return ids


def simulate(
    cfg: BenchmarkConfig, folder: Path, scene_ids: dict[str, list[str]], workers: Workers
) -> None:
    """Simulate every scene below `folder` that is not there yet."""
    split_of = {name: split for split, names in scene_ids.items() for name in names}
    jobs = {}
    for index in range(cfg.scenes):
        name = scene_id(cfg.seed, index)
        path = scene_path(folder, name)
        if not path.exists():
            jobs[name] = partial(_simulate_one, cfg, index, split_of[name], path)
    for _ in workers.run(jobs, "simulating scenes", "scene", done=cfg.scenes - len(jobs)):
        pass


def _simulate_one(cfg: BenchmarkConfig, index: int, split: str, path: Path) -> None:
    """Simulate a scene and, where the benchmark asks for it, the scene with an object absent."""
    bodies, motion = sample_bodies(cfg.seed, index, cfg)
    scene = record(path.stem, split, bodies, motion)
    if getattr(cfg.retrieval.counterfactual, split):
        removed = counterfactual.removed_object(scene, cfg.seed)
        if removed is not None:
            name = counterfactual.absent_id(scene.scene_id, removed)
            save_scene(without(name, split, bodies, removed), path.with_name(f"{name}.npz"))
    # Last, for where it stands the whole job is done.
    save_scene(scene, path)
