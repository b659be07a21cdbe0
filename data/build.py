"""Build a benchmark: simulate scenes, make items and queries, render the frames they name."""

from __future__ import annotations

import json
import logging
import multiprocessing
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import BenchmarkConfig, BuildCommand, Quota
from data.bullet import scene_id, simulate_scene
from data.frames import load_frames, save_frames
from data.records import SPLITS, FrameRef, RetrievalQuery, Scene, SelectionItem, shown_frames
from data.render import renderer
from data.retrieval import future
from data.retrieval.database import choose_frames, drop_twin_targets, share_of_scene
from data.selection import drafts, event, time, window
from data.store import (
    MANIFEST,
    VERSIONS,
    Store,
    digests,
    load_scene,
    open_store,
    save_rows,
    save_scene,
    write_atomically,
)

log = logging.getLogger(__name__)

FAMILY_BUILDERS = {"event": event, "time": time, "window": window}


@command("data.build", BuildCommand)
def main(cfg: BuildCommand, run: Run) -> dict[str, float]:
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    log.info(summary(store))
    return {name: float(count) for name, count in store.manifest["counts"].items()}


def ensure_benchmark(cfg: BenchmarkConfig, root: Path, workers: int) -> Store:
    """The benchmark that `cfg` describes below `root`, built where it is missing.

    Raises:
        UserError: a store of that name is there but was built from other settings, by another
            generator, or is damaged.
    """
    folder = root / cfg.name
    if not folder.exists():
        build(cfg, folder, workers)
    store = open_store(folder)
    _check_same_settings(store, cfg)
    return store


def build(cfg: BenchmarkConfig, folder: Path, workers: int) -> None:
    """Build a benchmark at `folder`, going on with what a killed build left."""
    log.info("building benchmark %s in %s", cfg.name, folder)
    growing = folder.with_name(f".{folder.name}.partial")
    _begin(cfg, growing)
    scene_ids = split_scenes(cfg)
    simulate(cfg, growing, scene_ids, workers)
    scene_of = lru_cache(maxsize=512)(lambda name: load_scene(growing / "scenes" / f"{name}.npz"))
    items = select_items(cfg, scene_ids, scene_of)
    queries = make_queries(cfg, scene_ids, scene_of)
    queries, database, twins = render(cfg, growing, scene_ids, items, queries, workers)
    _check_not_empty(cfg, items, queries)
    save_rows([i.to_row() for i in items], growing / "selection.parquet")
    save_rows([q.to_row() for q in queries], growing / "retrieval.parquet")
    save_rows([{**vars(f), "database": "test"} for f in database], growing / "database.parquet")
    counts = _counts(scene_ids, items, queries, database) | {"twin_frames_left_out": twins}
    shortfalls = _shortfalls(cfg, items, queries, database)
    _finish(cfg, growing, scene_ids, counts, shortfalls)
    growing.rename(folder)


def split_scenes(cfg: BenchmarkConfig) -> dict[str, list[str]]:
    """Scene ids of each split, in order of index: a seeded share of the scenes is for testing."""
    order = np.random.default_rng([cfg.seed, cfg.scenes]).permutation(cfg.scenes)
    test = set(order[: round(cfg.test_share * cfg.scenes)].tolist())
    ids: dict[str, list[str]] = {split: [] for split in SPLITS}
    for index in range(cfg.scenes):
        ids["test" if index in test else "train"].append(scene_id(cfg.seed, index))
    return ids


def simulate(
    cfg: BenchmarkConfig, folder: Path, scene_ids: dict[str, list[str]], workers: int
) -> None:
    """Simulate every scene that is not there yet."""
    split_of = {name: split for split, names in scene_ids.items() for name in names}
    jobs = {
        name: partial(_simulate_one, cfg, index, split_of[name], folder / "scenes" / f"{name}.npz")
        for index in range(cfg.scenes)
        if not (folder / "scenes" / f"{(name := scene_id(cfg.seed, index))}.npz").exists()
    }
    for _ in _run_jobs(jobs, "simulating scenes", cfg.scenes, workers):
        pass


def _simulate_one(cfg: BenchmarkConfig, index: int, split: str, path: Path) -> None:
    save_scene(simulate_scene(cfg.seed, index, split, cfg), path)


def select_items(
    cfg: BenchmarkConfig, scene_ids: dict[str, list[str]], scene_of: Callable[[str], Scene]
) -> list[SelectionItem]:
    """Every selection item, family by family and cell by cell."""
    track = cfg.selection
    items = []
    for family, quotas in (("event", track.event), ("time", track.time), ("window", track.window)):
        builder = FAMILY_BUILDERS[family]
        _check_names(f"benchmark.selection.{family}", quotas, builder.CELLS)
        for subtype, quota in quotas.items():
            draw = partial(builder.draft, subtype)
            items += drafts.fill(
                subtype, draw, scene_ids, scene_of, quota, cfg.seed, track.min_displacement
            )
    return items


def make_queries(
    cfg: BenchmarkConfig, scene_ids: dict[str, list[str]], scene_of: Callable[[str], Scene]
) -> list[RetrievalQuery]:
    """Every future-state query, builder by builder."""
    track = cfg.retrieval
    _check_names("benchmark.retrieval.builders", track.builders, map(str, future.BUILDERS))
    queries = []
    for builder, quota in track.builders.items():
        queries += future.fill(
            int(builder),
            scene_ids,
            scene_of,
            quota,
            track.hard_negatives,
            cfg.selection.min_displacement,
            cfg.seed,
        )
    return queries


def render(
    cfg: BenchmarkConfig,
    folder: Path,
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    workers: int,
) -> tuple[list[RetrievalQuery], list[FrameRef], int]:
    """Render every frame that an item, a query or the test database names.

    Returns:
        The queries whose target has pixels of its own, the test database, and how many frames were
        left out of it as twins.
    """
    named = named_frames(cfg, items, queries)
    targets: dict[str, list[int]] = defaultdict(list)
    for query in queries:
        if query.split == "test":
            targets[query.target.scene_id].append(query.target.frame)
    total = cfg.retrieval.database if targets else 0
    jobs = {}
    for split, names in scene_ids.items():
        for k, name in enumerate(names):
            wanted = share_of_scene(total, len(names), k) if split == "test" else 0
            path = folder / "frames" / f"{name}.zip"
            jobs[name] = partial(
                _render_one, cfg, folder, name, named[name], targets[name], wanted, path
            )
    stands_for: dict[FrameRef, FrameRef] = {}
    twins = 0
    done = dict(_run_jobs(jobs, "rendering scenes", len(jobs), workers))
    for name in sorted(done):
        frames, left_out = done[name]
        twins += left_out
        stands_for |= {FrameRef(name, f): FrameRef(name, g) for f, g in frames.items()}
    database = [frame for frame, shown in stands_for.items() if frame == shown]
    return drop_twin_targets(queries, stands_for), database, twins


def _render_one(
    cfg: BenchmarkConfig,
    folder: Path,
    name: str,
    named: set[int],
    targets: list[int],
    wanted: int,
    path: Path,
) -> tuple[dict[int, int], int]:
    images = load_frames(path) if path.exists() else {}
    there = len(images)
    scene = load_scene(folder / "scenes" / f"{name}.npz")

    def image_of(frame: int) -> Image.Image:
        if frame not in images:
            images[frame] = renderer(cfg.width, cfg.height).render(scene, frame)
        return images[frame]

    for frame in sorted(named):
        image_of(frame)
    chosen = choose_frames(targets, image_of, scene.frames, wanted, cfg.seed, name)
    if images and len(images) > there:
        save_frames(images, path)
    return chosen


def named_frames(
    cfg: BenchmarkConfig, items: list[SelectionItem], queries: list[RetrievalQuery]
) -> dict[str, set[int]]:
    """The frames of each scene that items and queries show."""
    named: dict[str, set[int]] = defaultdict(set)
    for asked in (*items, *queries):
        shown = shown_frames(asked.prefix_start, asked.prefix_stop, cfg.prefix_frames)
        named[asked.scene_id].update(shown)
    for frame in (
        *(c for i in items for c in i.candidates),
        *(f for q in queries for f in (q.target, *q.hard_negatives)),
    ):
        named[frame.scene_id].add(frame.frame)
    return named


def _run_jobs(
    jobs: dict[str, Callable[[], Any]], title: str, total: int, workers: int
) -> Iterator[tuple[str, Any]]:
    """Run jobs in worker processes and give their results as they come, under a progress bar."""
    bar = tqdm(total=total, initial=total - len(jobs), desc=title, unit="scene", mininterval=1.0)
    # Spawned, not forked: a worker must not inherit the threads of libraries loaded here.
    context = multiprocessing.get_context("spawn")
    with bar, ProcessPoolExecutor(workers, mp_context=context) as pool:
        names = {pool.submit(job): name for name, job in jobs.items()}
        try:
            for future_result in as_completed(names):
                yield names[future_result], future_result.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _begin(cfg: BenchmarkConfig, growing: Path) -> None:
    """Go on in the folder of a killed build of the same settings, or begin a new one."""
    plan = {**VERSIONS, "config": asdict(cfg)}
    path = growing / MANIFEST
    if growing.exists() and (not path.exists() or json.loads(path.read_text()) != plan):
        log.info("a build of other settings was left in %s: beginning anew", growing)
        shutil.rmtree(growing)
    write_atomically(path, json.dumps(plan).encode())
    for leftover in growing.rglob(".*.partial"):
        leftover.unlink()


def _finish(
    cfg: BenchmarkConfig,
    growing: Path,
    scene_ids: dict[str, list[str]],
    counts: dict[str, int],
    shortfalls: dict[str, str],
) -> None:
    manifest = {
        "name": cfg.name,
        "seed": cfg.seed,
        **VERSIONS,
        "config": asdict(cfg),
        "counts": counts,
        "shortfalls": shortfalls,
        "scenes": scene_ids,
        "files": digests(growing),
    }
    write_atomically(growing / MANIFEST, json.dumps(manifest, indent=1).encode())


def _counts(
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    database: list[FrameRef],
) -> dict[str, int]:
    tally = Counter({f"scenes/{split}": len(names) for split, names in scene_ids.items()})
    tally.update(f"selection/{i.family}/{i.split}" for i in items)
    tally.update(f"retrieval/builder {q.builder}/{q.split}" for q in queries)
    tally["database/test"] = len(database)
    return dict(tally)


def _shortfalls(
    cfg: BenchmarkConfig,
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    database: list[FrameRef],
) -> dict[str, str]:
    """What every cell, builder and database has, where that is less than its quota."""
    found = Counter((f"{i.family}/{i.subtype}", i.split) for i in items)
    found.update((f"builder {q.builder}", q.split) for q in queries)
    track = cfg.selection
    wanted = {
        **{f"event/{cell}": quota for cell, quota in track.event.items()},
        **{f"time/{cell}": quota for cell, quota in track.time.items()},
        **{f"window/{cell}": quota for cell, quota in track.window.items()},
        **{f"builder {b}": quota for b, quota in cfg.retrieval.builders.items()},
    }
    short = {
        f"{cell}/{split}": f"{found[cell, split]} of {getattr(quota, split)}"
        for cell, quota in wanted.items()
        for split in SPLITS
        if found[cell, split] < getattr(quota, split)
    }
    if queries and len(database) < cfg.retrieval.database:
        short["database/test"] = f"{len(database)} of {cfg.retrieval.database}"
    return short


def _check_names(key: str, quotas: dict[str, Quota], known: Iterable[str]) -> None:
    known = list(known)
    for name in quotas:
        if name not in known:
            raise UserError(f"{key}.{name}: there is no such builder; there are {', '.join(known)}")


def _check_not_empty(
    cfg: BenchmarkConfig, items: list[SelectionItem], queries: list[RetrievalQuery]
) -> None:
    if not items and not queries:
        raise UserError(
            f"benchmark {cfg.name} would be empty: none of {cfg.scenes} scenes gave an item with "
            f"benchmark.selection.min_displacement={cfg.selection.min_displacement}; lower it, "
            "or raise benchmark.scenes or the quotas"
        )


def _check_same_settings(store: Store, cfg: BenchmarkConfig) -> None:
    built, asked = _flat(store.manifest["config"]), _flat(asdict(cfg))
    for key in built | asked:
        old, new = built.get(key), asked.get(key)
        if old != new:
            raise UserError(
                f"{store.folder} was built with benchmark.{key}={old}, you ask for {new}: "
                f"choose another name with benchmark.name=NAME, or delete {store.folder}"
            )


def _flat(config: dict[str, Any], above: str = "") -> dict[str, Any]:
    flat = {}
    for key, value in config.items():
        name = f"{above}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def summary(store: Store) -> str:
    """What a store holds and where it fell short, as a small table."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<28}{count:>8,}" for name, count in store.manifest["counts"].items()]
    for cell, found in store.manifest["shortfalls"].items():
        lines.append(f"  short: {cell} has {found}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
