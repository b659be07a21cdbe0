"""The scenes of a benchmark: simulated, or read from another simulator's release; and which split
each is in."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from conf.errors import UserError
from conf.schema import BenchmarkConfig
from data.parallel import Workers
from data.records import SPLITS
from data.releases.readers import READERS
from data.releases.validation import RecordError
from data.store import PARTS, save_scene, scene_path, write_atomically
from data.tracks.retrieval import counterfactual
from data.world.sampling import format_scene_id, record_scene, sample_bodies, simulate_without
from data.world.standins import simulate_standin

log = logging.getLogger(__name__)

SPLIT_BLOCK = 5
"""Consecutive scenes that are split together."""
TOLD = 5
"""Bad records of a release that are told one by one; the others are counted."""

Named = TypeVar("Named")


def make_scenes(
    cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Put every scene that is not there yet below `folder`.

    Returns:
        Scene ids by split, in a stable order, and counts of what was left out.

    Raises:
        UserError: a split would be empty, there is no such release, or `strict` and one of its
            records is bad.
    """
    if cfg.simulator == "bullet":
        names = [scene_name(cfg, index) for index in range(cfg.scenes)]
        scene_ids = split_scenes(cfg, names)
        simulate(cfg, folder, scene_ids, workers)
        return scene_ids, {}
    return read_release(cfg, folder, workers, strict)


def scene_name(cfg: BenchmarkConfig, index: int) -> str:
    """The id of a simulated scene. A stand-in's is no standard scene's."""
    name = format_scene_id(cfg.seed, index)
    return name if cfg.standin is None else f"standin_{cfg.standin}-{name}"


def split_scenes(cfg: BenchmarkConfig, scenes: Sequence[Named]) -> dict[str, list[Named]]:
    """The scenes of each split in their order: of every few scenes a seeded share is for testing.

    A scene's split follows from the seed and its index alone, so that a larger benchmark never
    trains on what a smaller one tests: both simulate the same scenes.

    Raises:
        UserError: a split would be empty.
    """
    found: dict[str, list[Named]] = {split: [] for split in SPLITS}
    for first in range(0, len(scenes), SPLIT_BLOCK):
        share = [round(cfg.test_share * n) for n in (first, first + SPLIT_BLOCK)]
        order = np.random.default_rng([cfg.seed, first // SPLIT_BLOCK]).permutation(SPLIT_BLOCK)
        test = set(order[: share[1] - share[0]].tolist())
        for k, scene in enumerate(scenes[first : first + SPLIT_BLOCK]):
            found["test" if k in test else "train"].append(scene)
    for split in SPLITS if cfg.test_share < 1 else ("test",):
        if not found[split]:
            raise UserError(
                f"benchmark.test_share={cfg.test_share} of {len(scenes)} scenes leaves none to "
                f"{split} on: take more scenes (benchmark.scenes={cfg.scenes} at most)"
            )
    return found


def simulate(
    cfg: BenchmarkConfig, folder: Path, scene_ids: dict[str, list[str]], workers: Workers
) -> None:
    """Simulate every scene below `folder` that is not there yet."""
    split_of = {name: split for split, names in scene_ids.items() for name in names}
    jobs = {}
    for index in range(cfg.scenes):
        name = scene_name(cfg, index)
        path = scene_path(folder, name)
        if not path.exists():
            jobs[name] = partial(_simulate_one, cfg, index, split_of[name], path)
    for _ in workers.run(jobs, "simulating scenes", "scene", done=cfg.scenes - len(jobs)):
        pass


def _simulate_one(cfg: BenchmarkConfig, index: int, split: str, path: Path) -> None:
    """Simulate a scene and, where the benchmark asks for it, the scene with an object absent."""
    if cfg.standin is not None:
        save_scene(simulate_standin(path.stem, index, split, cfg), path)
        return
    bodies, motion = sample_bodies(cfg.seed, index, cfg)
    scene = record_scene(path.stem, split, bodies, motion)
    if getattr(cfg.retrieval.counterfactual, split):
        removed = counterfactual.removed_object(scene, cfg.seed)
        if removed is not None:
            name = counterfactual.absent_id(scene.scene_id, removed)
            save_scene(
                simulate_without(name, split, bodies, removed), path.with_name(f"{name}.npz")
            )
    # Last, for where it stands the whole job is done.
    save_scene(scene, path)


def read_release(
    cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Read the scenes of a release; see `make_scenes`. A record that is not as published is told
    and left out, unless `strict`."""
    if cfg.folder is None:
        raise UserError(
            f"benchmark.simulator={cfg.simulator} reads a release: name its folder with "
            "benchmark.folder=FOLDER"
        )
    source = Path(cfg.folder)
    paths = READERS[cfg.simulator].list_scenes(source)[: cfg.scenes]
    split_of = {path: split for split, found in split_scenes(cfg, paths).items() for path in found}
    parts = {str(path): _record_part(folder, path, split_of[path]) for path in paths}
    jobs = {
        str(path): partial(_read_one, cfg, path, split_of[path], folder, parts[str(path)])
        for path in paths
        if not parts[str(path)].exists()
    }
    done = len(paths) - len(jobs)
    for _ in workers.run(jobs, f"reading {cfg.simulator}", "scene", done):
        pass
    scene_ids: dict[str, list[str]] = {split: [] for split in SPLITS}
    bad = []
    for path in paths:
        told = json.loads(parts[str(path)].read_bytes())
        if "problem" in told:
            bad.append(told["problem"])
            if strict:
                raise UserError(f"{bad[0]} (strict=false leaves such records out)")
        else:
            scene_ids[split_of[path]].append(told["scene_id"])
    for problem in bad[:TOLD]:
        log.warning("left out: %s", problem)
    if len(bad) > TOLD:
        log.warning("left out: %d more bad records of %d", len(bad) - TOLD, len(paths))
    return scene_ids, {"bad records left out": len(bad)}


def _record_part(folder: Path, path: Path, split: str) -> Path:
    """Where it is kept what came of reading a record; a file that changed is read again."""
    file = path if path.exists() else path.parent
    about = [str(path), split, file.stat().st_size, file.stat().st_mtime_ns]
    key = hashlib.sha256(json.dumps(about).encode()).hexdigest()
    return folder / PARTS / f"{key[:32]}.json"


def _read_one(cfg: BenchmarkConfig, path: Path, split: str, folder: Path, part: Path) -> None:
    release, source = READERS[cfg.simulator], Path(cfg.folder)
    rate = {"fps": cfg.fps} if cfg.simulator == "physion" else {}
    try:
        scene = release.read_scene(path, source, split, **rate)
    except RecordError as error:
        told = {"problem": str(error)}
    else:
        save_scene(scene, scene_path(folder, scene.scene_id))
        told = {"scene_id": scene.scene_id}
    write_atomically(part, json.dumps(told).encode())
