"""Build a benchmark: simulate scenes, make items, queries and databases, render their frames."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

from conf.entry import Run, command
from conf.errors import SettingsError, UserError
from conf.keys import nearest
from conf.schema import BenchmarkConfig, BuildCommand
from data.parallel import Workers
from data.partial_build import flatten, lock_partial_build
from data.render.prerender import RECORD, prerender_frames
from data.store import (
    FRAMES,
    MANIFEST,
    PARTS,
    PLAN,
    Store,
    add_checksum,
    component_versions,
    hash_files,
    load_scene,
    open_store,
    save_rows,
    scene_path,
    write_atomically,
)
from data.tracks.build_items import family_quotas, item_families, make_items_and_queries, suite_name
from data.tracks.retrieval import future
from data.tracks.retrieval.database import make_databases
from data.tracks.shortfalls import count_records, find_shortfalls, summarize_store
from data.world.scenes import make_scenes

log = logging.getLogger(__name__)


@command("data.build", BuildCommand)
def main(cfg: BuildCommand, run: Run) -> dict[str, float]:
    workers = Workers(cfg.workers, cfg.parallel)
    store = ensure_items(cfg.benchmark, Path(cfg.store), workers, cfg.strict)
    prerender_frames(store, cfg.frames, cfg.frames_gb, workers)
    log.info(summarize_store(store))
    return {name: float(count) for name, count in store.manifest["counts"].items()}


def ensure_benchmark(cfg: BenchmarkConfig, root: Path, workers: int) -> Store:
    """The benchmark that `cfg` describes below `root`, built where it is missing, with the frames
    that it names; see `ensure_items`."""
    store = ensure_items(cfg, root, Workers(workers))
    if not (store.folder / FRAMES / RECORD).exists():
        prerender_frames(store, "named", None, Workers(workers))
    return store


def ensure_items(cfg: BenchmarkConfig, root: Path, workers: Workers, strict: bool = False) -> Store:
    """The benchmark that `cfg` describes below `root`, built where it is missing, whatever frames
    of it are rendered.

    Raises:
        UserError: a store of that name is there but was built from other settings, by another
            generator, or is damaged.
    """
    check_names(cfg)
    folder = root / cfg.name
    if not folder.exists():
        build(cfg, folder, workers, strict)
    store = open_store(folder)
    _check_same_settings(store, cfg)
    return store


def build(cfg: BenchmarkConfig, folder: Path, workers: Workers, strict: bool = False) -> None:
    """Build a benchmark without its frames at `folder`, going on with what a killed build left. A
    bad record of a release stops it where `strict`."""
    check_names(cfg)
    log.info("building benchmark %s in %s", cfg.name, folder)
    with lock_partial_build(cfg, folder) as growing:
        if growing is None:
            return
        scene_ids, unread = make_scenes(cfg, growing, workers, strict)
        items, queries, dropped = make_items_and_queries(cfg, growing, scene_ids, workers)
        scene_of = lru_cache(maxsize=None)(lambda name: load_scene(scene_path(growing, name)))
        queries, databases, left_out = make_databases(cfg, queries, scene_ids, scene_of)
        _check_not_empty(cfg, items, queries)
        save_rows([i.to_row() for i in items], growing / "selection.parquet")
        save_rows([q.to_row() for q in queries], growing / "retrieval.parquet")
        rows = [{**vars(f), "database": name} for name in databases for f in databases[name]]
        save_rows(rows, growing / "database.parquet")
        manifest = {
            "name": cfg.name,
            "suite": suite_name(cfg),
            "seed": cfg.seed,
            **component_versions(cfg.simulator, cfg.renderer, cfg.standin),
            "config": asdict(cfg),
            "counts": count_records(scene_ids, items, queries, databases)
            | unread
            | dropped
            | left_out,
            "shortfalls": find_shortfalls(cfg, items, queries, databases),
            "scenes": scene_ids,
            "files": hash_files(growing),
        }
        write_atomically(growing / MANIFEST, json.dumps(add_checksum(manifest), indent=1).encode())
        growing.rename(folder)
        shutil.rmtree(folder / PARTS)
        (folder / PLAN).unlink()


def check_names(cfg: BenchmarkConfig) -> None:
    """Raises SettingsError where a quota names a family, cell or builder that does not exist."""
    named = [
        (f"benchmark.selection.{family}", quotas, list(item_families(cfg)[family].CELLS))
        for family, quotas in family_quotas(cfg).items()
        if family in item_families(cfg)
    ]
    builders = [str(b) for b in future.BUILDERS]
    named.append(("benchmark.retrieval.builders", cfg.retrieval.builders, builders))
    problems = [
        f"{key}.{name}: there is no such builder, did you mean {nearest(name, known) or known[0]}? "
        f"There are {', '.join(known)}"
        for key, quotas, known in named
        for name in quotas
        if name not in known
    ]
    problems += [
        f"benchmark.selection.{family}: suite {suite_name(cfg)} has no items of it, "
        "leave the family out"
        for family, quotas in family_quotas(cfg).items()
        if quotas and family not in item_families(cfg)
    ]
    if problems:
        raise SettingsError("\n".join(problems))


def _check_not_empty(cfg: BenchmarkConfig, items: list, queries: list) -> None:
    if not items and not queries:
        raise UserError(
            f"benchmark {cfg.name} would be empty: none of its scenes gave an item with "
            f"benchmark.selection.min_displacement={cfg.selection.min_displacement}; lower it, "
            "or raise benchmark.scenes or the quotas"
        )


def _check_same_settings(store: Store, cfg: BenchmarkConfig) -> None:
    built, asked = flatten(store.manifest["config"]), flatten(asdict(cfg))
    for key in (built | asked).keys() - {"folder"}:
        old, new = built.get(key), asked.get(key)
        if old != new:
            raise UserError(
                f"{store.folder} was built with benchmark.{key}={old}, you ask for {new}: "
                f"choose another name with benchmark.name=NAME, or delete {store.folder}"
            )


if __name__ == "__main__":
    main()
