"""Reads the scenes of other simulators' releases, and the pixels of their frames.

There is one reader per simulator, a module with three functions:

    list_scenes(folder) -> list[Path]           one path per scene, in a stable order
    read_scene(path, folder, split) -> Scene    the scene at one of these paths
    load_images(scene, folder, frames) -> dict  RGB images by frame index

`folder` is the release's folder; `Scene.footage` is relative to it. `list_scenes` raises UserError
for a folder without scenes, and for a scene that occurs twice. `read_scene` reads only the scene's
own files and checks that its frames exist, so scenes can be read in any order and in separate
processes. `read_scene` and `load_images` raise `RecordError` for a record that is damaged or does
not have the published layout. `read_scene` returns what `reconcile_velocities` makes of the scene.
`physion.read_scene` also has the argument `fps`, because most of Physion's trials do not record
their frame rate.
"""

from __future__ import annotations

import json
import logging
import warnings
from functools import partial
from itertools import groupby
from pathlib import Path
from types import ModuleType

from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.files import write_bytes
from dynapix.conf.schema import BenchmarkConfig
from dynapix.data.parallel import Workers
from dynapix.data.records import SPLITS
from dynapix.data.sources import clevrer, movi_a, physion, tracks
from dynapix.data.sources.validation import RecordError, RescaledVelocities
from dynapix.data.store import part_path, save_scene, scene_path

log = logging.getLogger(__name__)

READERS: dict[str, ModuleType] = {
    "clevrer": clevrer, "movi_a": movi_a, "physion": physion, "tracks": tracks,
}  # fmt: skip
LOGGED_PROBLEMS = 5
"""Maximum number of invalid records that are logged one by one; the others are counted."""


def list_release(cfg: BenchmarkConfig) -> list[list[Path]]:
    """Return the paths of a release's scenes, at most `cfg.scenes`, by video: all clips of a video
    belong in one split. Raises UserError as the readers do, and if `cfg.folder` is not set."""
    if cfg.folder is None:
        raise UserError(
            f"benchmark.simulator={cfg.simulator} reads a release: set its folder with "
            "benchmark.folder=FOLDER",
            code="missing-setting",
        )
    paths = READERS[cfg.simulator].list_scenes(Path(cfg.folder))[: cfg.scenes]
    if cfg.simulator == "tracks":
        return [list(clips) for _, clips in groupby(paths, key=lambda path: path.parent)]
    return [[path] for path in paths]


def read_release(
    cfg: BenchmarkConfig,
    splits: dict[str, list[Path]],
    folder: Path,
    workers: Workers,
    strict: bool,
) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Write the scenes at the paths `splits` of a release below `folder`; see `make_scenes`."""
    jobs, split_of = {}, {}
    for split, paths in splits.items():
        for path in paths:
            part = part_path(folder, [str(path), split, *_stamps(path, Path(cfg.folder))])
            if part.exists() and "problem" in json.loads(part.read_bytes()):
                # The problem may have been fixed since, such as a missing video beside the record.
                part.unlink()
            jobs[part] = partial(_read_one, cfg, path, split, folder, part)
            split_of[part] = split
    workers.write_files(jobs, f"reading {cfg.simulator}", "scene")
    scene_ids: dict[str, list[str]] = {split: [] for split in SPLITS}
    problems, factors, sizes = [], [], set()
    for part, split in split_of.items():
        outcome = json.loads(part.read_bytes())
        if "problem" in outcome:
            problems.append(outcome["problem"])
        else:
            scene_ids[split].append(outcome["scene_id"])
            factors += outcome["factors"]
            sizes.add(tuple(outcome["image_size"]))
    for size in sizes:
        for problem in cfg.find_pixel_problem(*size):
            raise SettingsError(problem)
    if factors:
        bounds = dict.fromkeys(f"{bound(factors):.3g}" for bound in (min, max))
        other = f", or benchmark.fps={cfg.fps:g} is wrong" if cfg.simulator == "physion" else ""
        log.warning(
            f"velocities of {len(factors)} scenes of {len(split_of)} were multiplied by "
            f"{' to '.join(bounds)}, so that they agree with the positions: the release has "
            f"another unit of time{other}"
        )
    if problems and strict:
        raise UserError(
            f"{problems[0]} (strict=false leaves such records out)", code="invalid-record"
        )
    for problem in problems[:LOGGED_PROBLEMS]:
        log.warning("left out: %s", problem)
    if (more := len(problems) - LOGGED_PROBLEMS) > 0:
        log.warning("left out: %d more invalid records of %d", more, len(split_of))
    return scene_ids, {"bad records left out": len(problems)}


def _stamps(path: Path, folder: Path) -> list[tuple[int, int]]:
    """Return the sizes and the times of the files of a record, so that it is read again when one
    has changed: its own file, those beside it with the same stem, and those with names."""
    file = path if path.exists() else path.parent
    files = sorted({file, *file.parent.glob(f"{file.stem}.*"), *folder.glob("*.yaml")})
    return [(each.stat().st_size, each.stat().st_mtime_ns) for each in files]


def _read_one(cfg: BenchmarkConfig, path: Path, split: str, folder: Path, part: Path) -> None:
    reader, source = READERS[cfg.simulator], Path(cfg.folder)
    rate = {"fps": cfg.fps} if cfg.simulator == "physion" else {}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RescaledVelocities)
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
    except UserError:
        raise
    except Exception as error:
        # A library's own error of a record that a reader does not check.
        where = getattr(error, "filename", None) or path
        outcome = {"problem": f"{where}: {type(error).__name__}: {error}"}
    else:
        save_scene(scene, scene_path(folder, scene.scene_id))
        rescaled = [w.message for w in caught if isinstance(w.message, RescaledVelocities)]
        factors = [each.factor for each in rescaled]
        outcome = {"scene_id": scene.scene_id, "factors": factors, "image_size": scene.image_size}
    write_bytes(part, json.dumps(outcome).encode())
