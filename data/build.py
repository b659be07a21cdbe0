"""Build a benchmark: simulate scenes, make items, queries and databases, and render frames."""

from __future__ import annotations

import functools
import json
import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.files import is_writable, read_json, refuse_broken_link, write_bytes, write_json
from dynapix.conf.runs import compare_settings, flatten, lock_file
from dynapix.conf.schema import BenchmarkConfig, BuildCommand, WorldConfig
from dynapix.data.checks.counts import count_records, summarize_store
from dynapix.data.frames.prerender import FRAMES_RECORD, prerender_frames
from dynapix.data.items.cells import (
    family_quotas,
    list_subtypes,
    load_cached,
    make_items_and_queries,
)
from dynapix.data.items.database import make_databases
from dynapix.data.items.futures import contact
from dynapix.data.items.futures.interventions import CHANGES
from dynapix.data.items.queries import BUILDERS
from dynapix.data.oracle.displacement import visible_positions
from dynapix.data.parallel import Workers
from dynapix.data.records import CONTACT, COUNTERFACTUAL, SPLITS, Scene, SelectionItem
from dynapix.data.render.blender import check_blender
from dynapix.data.sources.scenes import make_scenes
from dynapix.data.store import (
    FRAMES_FOLDER,
    MANIFEST,
    PARTS,
    PLAN,
    SCENES_FOLDER,
    TABLES,
    Store,
    hash_files,
    open_store,
    save_rows,
    with_checksum,
)
from dynapix.data.versions import component_versions

log = logging.getLogger(__name__)

SCENE_SETTINGS = ("simulator", "world", "seed", "test_share", "fps")
"""Settings that determine the content of the scenes. A killed build resumes only with the same
values of these. Other settings may change: they determine which scenes there are, and the name of a
file in `PARTS` is a hash of its job's inputs."""


@command("data.build", BuildCommand)
def main(cfg: BuildCommand, run: Run) -> dict[str, float]:
    if cfg.frames != "none":
        check_renderer(cfg.benchmark, Path(cfg.store))
    workers = Workers(cfg.workers, cfg.parallel)
    store = ensure_items(cfg.benchmark, Path(cfg.store), workers, cfg.strict, cfg.verify)
    if cfg.frames != "none":
        prerender_frames(store, cfg.frames, workers)
    log.info(summarize_store(store))
    return {name: float(count) for name, count in store.manifest["counts"].items()}


def ensure_benchmark(cfg: BenchmarkConfig, root: Path, workers: int) -> Store:
    """Open a benchmark as `ensure_items` does, and render the frames that its records refer to,
    unless the store cannot be written: frames are then rendered when they are needed."""
    check_renderer(cfg, root)
    store = ensure_items(cfg, root, Workers(workers))
    is_rendered = (store.folder / FRAMES_FOLDER / FRAMES_RECORD).exists()
    if not is_rendered and is_writable(store.folder):
        prerender_frames(store, "named", Workers(workers))
    return store


def check_renderer(cfg: BenchmarkConfig, root: Path) -> None:
    """Raises UserError as `check_blender` does if a benchmark that is not built yet needs Blender:
    otherwise, the error would come after the simulation of the scenes."""
    is_rendered = cfg.simulator == "bullet" and cfg.renderer == "blender"
    if is_rendered and not (root / cfg.store_name).exists():
        check_blender()


def ensure_items(
    cfg: BenchmarkConfig, root: Path, workers: Workers, strict: bool = False, verify: bool = False
) -> Store:
    """Open the benchmark `root / cfg.store_name`; build it first, without frames, if it is missing.
    Raises UserError as `open_store` does, or if the benchmark was built with other settings."""
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
    refuse_broken_link(folder)
    log.info("building benchmark %s in %s", cfg.store_name, folder)
    with lock_partial_build(cfg, folder) as partial:
        if partial is None:
            return
        scene_ids, left_out = make_scenes(cfg, partial, workers, strict)
        items, queries, dropped = make_items_and_queries(cfg, partial, scene_ids, workers)
        save_rows([asdict(i) for i in items], partial / "selection.parquet")
        scene_of = functools.partial(load_cached, partial)
        queries, databases, unused = make_databases(cfg, queries, scene_ids, scene_of)
        if not items and not queries:
            raise empty_benchmark(cfg, scene_ids, scene_of, left_out)
        save_rows([asdict(q) for q in queries], partial / "retrieval.parquet")
        rows = [{**vars(f), "database": name} for name in databases for f in databases[name]]
        save_rows(rows, partial / "database.parquet")
        counts, shortfalls = count_records(cfg, scene_ids, items, queries, databases)
        scenes = list_used_scenes(partial, scene_ids, items)
        used = {f"{SCENES_FOLDER}/{name}.npz" for name in scenes}
        manifest = {
            "name": cfg.store_name,
            "suite": cfg.suite,
            "seed": cfg.seed,
            **component_versions(asdict(cfg)),
            "config": asdict(cfg),
            "world_changes": world_changes(cfg.world),
            "counts": counts | left_out | dropped | unused,
            "shortfalls": shortfalls,
            "scenes": scene_ids,
            "files": hash_files(partial, sorted([*TABLES, *used])),
        }
        write_bytes(partial / MANIFEST, json.dumps(with_checksum(manifest), indent=1).encode())
        # The results of the jobs go first: a build that is killed from here on makes them again,
        # together with the alternative futures to which they refer.
        shutil.rmtree(partial / PARTS, ignore_errors=True)
        for path in (partial / SCENES_FOLDER).glob("*.npz"):
            if path.relative_to(partial).as_posix() not in used:
                path.unlink()
        partial.rename(folder)
        (folder / PLAN).unlink()


def list_used_scenes(
    folder: Path, scene_ids: Mapping[str, Sequence[str]], items: Sequence[SelectionItem]
) -> set[str]:
    """Return the ids of the scenes of a benchmark, of their counterfactuals, and of the alternative
    futures that items refer to. A killed build with other settings may have left further ones."""
    used = {name for names in scene_ids.values() for name in names}
    every = {path.stem for path in (folder / SCENES_FOLDER).glob("*.npz")}
    used |= {name for name in every if name.partition(COUNTERFACTUAL)[0] in used}
    return used | {candidate.scene_id for item in items for candidate in item.candidates}


def empty_benchmark(
    cfg: BenchmarkConfig,
    scene_ids: Mapping[str, Sequence[str]],
    scene_of: Callable[[str], Scene],
    left_out: Mapping[str, int],
) -> UserError:
    """Return an error that says why a benchmark would contain no item and no query."""
    names = [name for ids in scene_ids.values() for name in ids]
    is_simulated = cfg.simulator == "bullet"
    if is_simulated and not any(visible_positions(scene_of(n))[1].any() for n in names):
        return UserError(
            f"no scene of the benchmark {cfg.name} shows an object: move benchmark.world.camera, "
            "or benchmark.world.parts, which may hide the objects",
            code="impossible-world",
        )
    if cfg.distractors == CONTACT and not any(
        contact.collision_timings(gap, scene_of(name))
        for gap in contact.CELLS.values()
        for name in names
    ):
        return UserError(
            f"no scene of the benchmark {cfg.name} has a collision with a prefix of "
            f"{contact.OBSERVED} frames before it: raise benchmark.world.start.distance of world="
            f"{cfg.world.name} if objects meet earlier, or benchmark.world.start.speed if they do "
            "not meet",
            code="no-collisions",
        )
    reasons = "".join(f" ({count} {what})" for what, count in left_out.items() if count)
    return UserError(
        f"benchmark {cfg.name} would contain no item and no query{reasons}: raise "
        "benchmark.scenes or the quotas, or lower benchmark.selection.min_displacement="
        f"{cfg.selection.min_displacement}",
        code="empty-benchmark",
    )


def world_changes(world: WorldConfig) -> dict[str, Any]:
    """Return the settings of a world that differ from those of CLEVRER's world, by dotted key."""
    usual, settings = flatten(asdict(WorldConfig())), flatten(asdict(world))
    return {
        key: settings.get(key)
        for key in sorted(settings.keys() | usual.keys())
        if settings.get(key) != usual.get(key)
    }


def check_quota_names(cfg: BenchmarkConfig) -> None:
    """Raises SettingsError if a quota is set for an unknown family, subtype or builder."""
    from dynapix.conf.compose import nearest_key

    subtypes = list_subtypes(cfg)
    named = {f"selection.{name}": (own, subtypes[name]) for name, own in family_quotas(cfg).items()}
    named["selection.interventions"] = cfg.selection.interventions, (*CHANGES,)
    named["retrieval.builders"] = cfg.retrieval.builders, [str(b) for b in BUILDERS]
    problems = []
    for key, (settings, options) in named.items():
        if settings and not options:
            problems.append(
                f"benchmark.{key}: suite {cfg.suite} with benchmark.distractors={cfg.distractors} "
                "lacks this family; remove its quotas"
            )
            continue
        problems += [
            f"benchmark.{key}.{name}: unknown name; did you mean "
            f"{nearest_key(name, options) or options[0]}? With benchmark.distractors="
            f"{cfg.distractors}, the names are {', '.join(options)}"
            for name in settings
            if name not in options
        ]
    if problems:
        raise SettingsError("\n".join(problems), code="unknown-option")


@contextmanager
def lock_partial_build(cfg: BenchmarkConfig, folder: Path) -> Iterator[Path | None]:
    """Lock the partial build of `folder`, and wait while another process has locked it. Raises
    UserError if the partial build has other settings.

    Yields:
        The folder of the partial build, which may contain files of a killed build; None if another
        process has completed `folder` in the meantime.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    plan = {
        "generator": component_versions(asdict(cfg))["generator"],
        "benchmark": {key: asdict(cfg)[key] for key in SCENE_SETTINGS},
        "counterfactual scenes": {
            split: getattr(cfg.retrieval.counterfactual, split) > 0 for split in SPLITS
        },
    }
    busy = f"{folder} is being built by another process"
    with lock_file(partial.with_suffix(".lock"), busy, wait=True):
        if folder.exists():
            shutil.rmtree(partial, ignore_errors=True)
            yield None
            return
        partial.mkdir(exist_ok=True)
        if (partial / PLAN).exists() and any((partial / SCENES_FOLDER).glob("*.npz")):
            # Simulating scenes can take hours, so a changed setting must not discard them silently.
            check_same_settings(read_json(partial / PLAN), plan, partial)
        for leftover in partial.rglob(".*.partial"):
            leftover.unlink()
        write_json(partial / PLAN, plan)
        yield partial


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
