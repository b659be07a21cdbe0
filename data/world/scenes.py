"""Simulates the scenes of a benchmark or reads them from a release, in two splits."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from conf.errors import UserError
from conf.files import write_bytes
from conf.schema import BenchmarkConfig
from data.parallel import Workers
from data.records import SPLITS
from data.releases.readers import READERS
from data.releases.transfer_suites import suite_name
from data.releases.validation import RecordError
from data.store import part_path, save_scene, scene_path
from data.tracks.retrieval import counterfactual
from data.world.sampling import format_scene_id, record_scene, sample_scene, simulate_without

log = logging.getLogger(__name__)

SPLIT_BLOCK = 5
"""Number of consecutive scenes in a block; each block is divided between the splits."""
LOGGED_PROBLEMS = 5
"""Maximum number of invalid records that are logged one by one; the others are counted."""

Element = TypeVar("Element")


def make_scenes(
    cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Write every missing scene below `folder`.

    Returns:
        Scene ids by split, in a stable order, and the number of invalid records.

    Raises:
        UserError: a split would be empty, the release is missing, or `strict` is set and a record
            is invalid.
    """
    if cfg.simulator != "bullet":
        return read_release(cfg, folder, workers, strict)
    names = [scene_prefix(cfg) + format_scene_id(cfg.seed, k) for k in range(cfg.scenes)]
    scene_ids = split_scenes(cfg, names)
    split_of = {name: split for split, ids in scene_ids.items() for name in ids}
    paths = {name: scene_path(folder, name) for name in names}
    jobs = {
        paths[name]: partial(_simulate_one, cfg, index, split_of[name], paths[name])
        for index, name in enumerate(names)
    }
    workers.write_files(jobs, "simulating scenes", "scene")
    return scene_ids, {}


def scene_prefix(cfg: BenchmarkConfig) -> str:
    """Return the start of the ids of a benchmark's scenes, so that ids differ between worlds."""
    if cfg.item_recipe != "dynapix":
        return f"{suite_name(cfg)}-"
    return "" if cfg.world.name == "clevrer" else f"{cfg.world.name}-"


def split_scenes(cfg: BenchmarkConfig, scenes: Sequence[Element]) -> dict[str, list[Element]]:
    """Assign a random share of every `SPLIT_BLOCK` scenes to the test split; the order is kept.

    A scene's split depends only on its index, the seed and the test share, so that a scene has the
    same split in a smaller and in a larger benchmark.

    Raises:
        UserError: a split would be empty.
    """
    splits: dict[str, list[Element]] = {split: [] for split in SPLITS}
    for first in range(0, len(scenes), SPLIT_BLOCK):
        share = [round(cfg.test_share * n) for n in (first, first + SPLIT_BLOCK)]
        order = np.random.default_rng([cfg.seed, first // SPLIT_BLOCK]).permutation(SPLIT_BLOCK)
        test = set(order[: share[1] - share[0]].tolist())
        for k, scene in enumerate(scenes[first : first + SPLIT_BLOCK]):
            splits["test" if k in test else "train"].append(scene)
    for split in SPLITS if cfg.test_share < 1 else ("test",):
        if not splits[split]:
            raise UserError(
                f"benchmark.test_share={cfg.test_share} of {len(scenes)} scenes leaves no {split} "
                f"scene: change it, or use more scenes (benchmark.scenes={cfg.scenes})",
                code="empty-split",
            )
    return splits


def _simulate_one(cfg: BenchmarkConfig, index: int, split: str, path: Path) -> None:
    """Simulate a scene and, for counterfactual queries, the scene without one of its objects."""
    sample = sample_scene(cfg.world, cfg.seed, index)
    scene = record_scene(path.stem, split, sample, cfg.world)
    if getattr(cfg.retrieval.counterfactual, split):
        removed = counterfactual.removed_object(scene, cfg.seed)
        if removed is not None:
            name = counterfactual.counterfactual_id(scene.scene_id, removed)
            other = simulate_without(name, split, sample.bodies, removed, cfg.world)
            save_scene(other, path.with_name(f"{name}.npz"))
    # This file is saved last, because it marks the job as done.
    save_scene(scene, path)


def read_release(
    cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Read the scenes of a release; see `make_scenes`.

    An invalid record is logged and left out, unless `strict` is set.
    """
    if cfg.folder is None:
        raise UserError(
            f"benchmark.simulator={cfg.simulator} reads a release: set its folder with "
            "benchmark.folder=FOLDER",
            code="missing-setting",
        )
    source = Path(cfg.folder)
    paths = READERS[cfg.simulator].list_scenes(source)[: cfg.scenes]
    jobs, split_of = {}, {}
    for split, split_paths in split_scenes(cfg, paths).items():
        for path in split_paths:
            file = path if path.exists() else path.parent
            # Size and time of the file, so that a record that has changed is read again.
            inputs = [str(path), split, file.stat().st_size, file.stat().st_mtime_ns]
            part = part_path(folder, inputs)
            if _problem_of(part):
                # The problem may have been fixed since, such as a missing video beside the record.
                part.unlink()
            jobs[part] = partial(_read_one, cfg, path, split, folder, part)
            split_of[part] = split
    workers.write_files(jobs, f"reading {cfg.simulator}", "scene")
    scene_ids: dict[str, list[str]] = {split: [] for split in SPLITS}
    problems = []
    for part, split in split_of.items():
        if problem := _problem_of(part):
            problems.append(problem)
        else:
            scene_ids[split].append(json.loads(part.read_bytes())["scene_id"])
    if problems and strict:
        raise UserError(
            f"{problems[0]} (strict=false leaves such records out)", code="invalid-record"
        )
    for problem in problems[:LOGGED_PROBLEMS]:
        log.warning("left out: %s", problem)
    if len(problems) > LOGGED_PROBLEMS:
        more = len(problems) - LOGGED_PROBLEMS
        log.warning("left out: %d more invalid records of %d", more, len(paths))
    return scene_ids, {"bad records left out": len(problems)}


def _problem_of(part: Path) -> str | None:
    """Return why a record was left out; None if it was read, or not yet."""
    return json.loads(part.read_bytes()).get("problem") if part.exists() else None


def _read_one(cfg: BenchmarkConfig, path: Path, split: str, folder: Path, part: Path) -> None:
    reader, source = READERS[cfg.simulator], Path(cfg.folder)
    rate = {"fps": cfg.fps} if cfg.simulator == "physion" else {}
    try:
        scene = reader.read_scene(path, source, split, **rate)
    except RecordError as error:
        outcome = {"problem": str(error)}
    except PermissionError as error:
        # It is no fault of the record, which must not be left out without notice.
        raise UserError(
            f"{error.filename or path} cannot be read (permission denied): let this user read the "
            "release",
            code="unreadable-file",
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        outcome = {"problem": f"{getattr(error, 'filename', None) or path}: {error}"}
    else:
        save_scene(scene, scene_path(folder, scene.scene_id))
        outcome = {"scene_id": scene.scene_id}
    write_bytes(part, json.dumps(outcome).encode())
