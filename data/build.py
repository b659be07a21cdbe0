"""Build a benchmark: simulate scenes, make items, queries and databases, and render frames."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from conf.entry import Run, command
from conf.errors import SettingsError, UserError
from conf.files import read_json, write_bytes
from conf.runs import compare_settings, flatten, wait_for_lock
from conf.schema import BenchmarkConfig, BuildCommand, WorldConfig
from data.parallel import Workers
from data.records import SPLITS
from data.releases.transfer_suites import suite_name
from data.render.blender import check_blender
from data.render.prerender import FRAMES_RECORD, prerender_frames
from data.store import (
    FRAMES_FOLDER,
    MANIFEST,
    PARTS,
    PLAN,
    SCENES_FOLDER,
    Store,
    built_files,
    component_versions,
    hash_files,
    load_scene,
    open_store,
    save_rows,
    scene_path,
    with_checksum,
)
from data.tracks.build_items import (
    OBSERVATIONS,
    family_quotas,
    item_families,
    make_items_and_queries,
    remove_unused_futures,
)
from data.tracks.retrieval import future
from data.tracks.retrieval.database import make_databases
from data.tracks.shortfalls import count_records, summarize_store
from data.world.displacement import visible_positions
from data.world.physics import generator_version
from data.world.scenes import make_scenes

log = logging.getLogger(__name__)

SCENE_SETTINGS = ("simulator", "world", "seed", "test_share", "fps")
"""Settings that determine the scenes. A killed build resumes only with the same values of these.
Other settings may change, because the name of a file in `PARTS` is a hash of its job's inputs."""


@command("data.build", BuildCommand)
def main(cfg: BuildCommand, run: Run) -> dict[str, float]:
    if cfg.frames != "none":
        check_renderer(cfg.benchmark, Path(cfg.store))
    workers = Workers(cfg.workers, cfg.parallel)
    store = ensure_items(cfg.benchmark, Path(cfg.store), workers, cfg.strict, cfg.verify)
    prerender_frames(store, cfg.frames, cfg.frames_gb, workers)
    log.info(summarize_store(store))
    return {name: float(count) for name, count in store.manifest["counts"].items()}


def ensure_benchmark(cfg: BenchmarkConfig, root: Path, workers: int) -> Store:
    """Open a benchmark as `ensure_items` does, and render the frames that its records refer to."""
    check_renderer(cfg, root)
    store = ensure_items(cfg, root, Workers(workers))
    if not (store.folder / FRAMES_FOLDER / FRAMES_RECORD).exists():
        prerender_frames(store, "named", None, Workers(workers))
    return store


def check_renderer(cfg: BenchmarkConfig, root: Path) -> None:
    """Raises UserError if a benchmark that is not built yet needs Blender, as `check_blender` does.
    Without this check, the error would come after the simulation of the scenes."""
    is_rendered = cfg.simulator == "bullet" and cfg.renderer == "blender"
    if is_rendered and not (root / cfg.store_name).exists():
        check_blender()


def ensure_items(
    cfg: BenchmarkConfig, root: Path, workers: Workers, strict: bool = False, verify: bool = False
) -> Store:
    """Open the benchmark `root / cfg.store_name`; build it first, without frames, if it is missing.

    Raises:
        UserError: the existing store is damaged, or was built by another version of the code or
            with other settings.
    """
    check_quota_names(cfg)
    folder = root / cfg.store_name
    if not folder.exists():
        build(cfg, folder, workers, strict)
    store = open_store(folder, verify)
    # The release may have moved since the build.
    config = store.manifest["config"] | ({"folder": cfg.folder} if cfg.folder else {})
    check_same_settings(
        {"benchmark": config}, {"benchmark": asdict(cfg) | {"folder": config["folder"]}}, folder
    )
    return replace(store, manifest=store.manifest | {"config": config})


def build(cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool = False) -> None:
    """Build a benchmark without frames at `folder`, or resume a killed build of it.

    Args:
        strict: Fail if a record of a release is invalid, instead of leaving the record out.

    Raises:
        UserError: the benchmark would contain no item and no query.
    """
    check_quota_names(cfg)
    log.info("building benchmark %s in %s", cfg.store_name, folder)
    with lock_partial_build(cfg, folder) as partial:
        if partial is None:
            return
        scene_ids, invalid = make_scenes(cfg, partial, workers, strict)
        items, queries, dropped = make_items_and_queries(cfg, partial, scene_ids, workers)
        if cfg.distractors == "balanced":
            remove_unused_futures(partial, items)
        scene_of = lru_cache(maxsize=None)(lambda name: load_scene(scene_path(partial, name)))
        queries, databases, left_out = make_databases(cfg, queries, scene_ids, scene_of)
        if not items and not queries:
            names = [name for ids in scene_ids.values() for name in ids]
            is_simulated = cfg.simulator == "bullet"
            if is_simulated and not any(visible_positions(scene_of(n))[1].any() for n in names):
                raise UserError(
                    f"no scene of the benchmark {cfg.name} shows an object: move "
                    "benchmark.world.camera, or benchmark.world.parts, which may hide the objects",
                    code="impossible-world",
                )
            reasons = "".join(f" ({count} {what})" for what, count in invalid.items() if count)
            raise UserError(
                f"benchmark {cfg.name} would contain no item and no query{reasons}: raise "
                "benchmark.scenes or the quotas, or lower benchmark.selection.min_displacement="
                f"{cfg.selection.min_displacement}",
                code="empty-benchmark",
            )
        save_rows([i.to_row() for i in items], partial / "selection.parquet")
        save_rows([q.to_row() for q in queries], partial / "retrieval.parquet")
        rows = [{**vars(f), "database": name} for name in databases for f in databases[name]]
        save_rows(rows, partial / "database.parquet")
        counts, shortfalls = count_records(cfg, scene_ids, items, queries, databases)
        manifest = {
            "name": cfg.store_name,
            "suite": suite_name(cfg),
            "seed": cfg.seed,
            **component_versions(asdict(cfg)),
            "config": asdict(cfg),
            "world_changes": world_changes(cfg.world),
            "counts": counts | invalid | dropped | left_out,
            "shortfalls": shortfalls,
            "scenes": scene_ids,
            "files": hash_files(partial, built_files(partial)),
        }
        write_bytes(partial / MANIFEST, json.dumps(with_checksum(manifest), indent=1).encode())
        partial.rename(folder)
        shutil.rmtree(folder / PARTS)
        (folder / PLAN).unlink()


def world_changes(world: WorldConfig) -> dict[str, Any]:
    """Return the settings of a world that differ from those of CLEVRER's world, by dotted key."""
    usual = flatten(asdict(WorldConfig()))
    settings = flatten(asdict(world))
    return {
        key: settings.get(key)
        for key in sorted(settings.keys() | usual.keys())
        if settings.get(key) != usual.get(key)
    }


def check_quota_names(cfg: BenchmarkConfig) -> None:
    """Raises SettingsError if a quota is set for an unknown family, subtype or builder."""
    known = {f"selection.{name}": list(f.cells) for name, f in item_families(cfg).items()}
    known["retrieval.builders"] = [str(b) for b in future.BUILDERS]
    quotas = {f"selection.{family}": named for family, named in family_quotas(cfg).items()}
    from conf.compose import nearest_key

    problems = [
        f"benchmark.selection.observation.{name}: unknown name; give event, window or a subtype "
        "of theirs"
        for name in cfg.selection.observation
        if not any(
            name in (family, *known.get(f"selection.{family}", ())) for family in OBSERVATIONS
        )
    ]
    for key, named in {**quotas, "retrieval.builders": cfg.retrieval.builders}.items():
        options = known.get(key, [])
        if named and not options:
            problems.append(
                f"benchmark.{key}: suite {suite_name(cfg)} lacks this family; remove its quotas"
            )
        problems += [
            f"benchmark.{key}.{name}: unknown name; did you mean "
            f"{nearest_key(name, options) or options[0]}? The names are {', '.join(options)}"
            for name in named
            if options and name not in options
        ]
    if problems:
        raise SettingsError("\n".join(problems), code="unknown-option")


@contextmanager
def lock_partial_build(cfg: BenchmarkConfig, folder: Path) -> Iterator[Path | None]:
    """Lock the partial build of `folder`, and wait while another process has locked it.

    Yields:
        The folder of the partial build, which may contain files of a killed build; None if another
        process has completed `folder` in the meantime.

    Raises:
        UserError: the partial build has other settings.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    plan = {
        "generator": generator_version(cfg.world.physics.rolling_friction),
        "benchmark": {key: asdict(cfg)[key] for key in SCENE_SETTINGS},
        "counterfactual scenes": {
            split: getattr(cfg.retrieval.counterfactual, split) > 0 for split in SPLITS
        },
    }
    handle = os.open(partial, os.O_RDONLY)
    try:
        wait_for_lock(handle, f"{folder} is being built by another process")
        if folder.exists():
            shutil.rmtree(partial, ignore_errors=True)
            yield None
            return
        if (partial / PLAN).exists() and any((partial / SCENES_FOLDER).glob("*.npz")):
            # Simulating scenes can take hours, so a changed setting must not discard them silently.
            check_same_settings(read_json(partial / PLAN), plan, partial)
        for leftover in partial.rglob(".*.partial"):
            leftover.unlink()
        write_bytes(partial / PLAN, json.dumps(plan).encode())
        yield partial
    finally:
        os.close(handle)


def check_same_settings(old: dict[str, Any], new: dict[str, Any], folder: Path) -> None:
    """Raises UserError if the nested settings of two builds differ."""
    if changes := compare_settings(old, new):
        raise UserError(
            f"{folder} was built with other settings: {changes[0]}. Use the earlier value, "
            f"choose another name with benchmark.name=NAME, or delete {folder}",
            code="other-settings",
        )


if __name__ == "__main__":
    main()
