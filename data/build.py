"""Build a benchmark: simulate scenes, make items and queries, render the frames they name."""

from __future__ import annotations

import json
import logging
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import asdict, astuple
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from conf.entry import Run, command
from conf.errors import SettingsError, UserError
from conf.keys import nearest
from conf.schema import BenchmarkConfig, BuildCommand, Quota
from data.bullet import record, sample_bodies, scene_id, without
from data.frames import load_frames, save_frames
from data.growing import flat, growing_folder
from data.records import (
    POOLS,
    SPLITS,
    FrameRef,
    RetrievalQuery,
    Scene,
    SelectionItem,
    shown_frames,
)
from data.render import renderer
from data.retrieval import counterfactual, future
from data.retrieval.database import choose_frames, distinct, drop_twin_targets, share_of_scene
from data.selection import drafts, event, time, window
from data.store import (
    MANIFEST,
    PLAN,
    VERSIONS,
    Store,
    digests,
    load_scene,
    open_store,
    save_rows,
    save_scene,
    sealed,
    write_atomically,
)
from data.workers import pool

log = logging.getLogger(__name__)

SPLIT_BLOCK = 5
"""Consecutive scenes that are split together."""
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
    check_names(cfg)
    folder = root / cfg.name
    if not folder.exists():
        build(cfg, folder, workers)
    store = open_store(folder)
    _check_same_settings(store, cfg)
    return store


def build(cfg: BenchmarkConfig, folder: Path, workers: int) -> None:
    """Build a benchmark at `folder`, going on with what a killed build left."""
    check_names(cfg)
    scene_ids = split_scenes(cfg)
    log.info("building benchmark %s in %s", cfg.name, folder)
    with growing_folder(cfg, folder) as growing:
        simulate(cfg, growing, scene_ids, workers)
        scene_of = lru_cache(maxsize=512)(
            lambda name: load_scene(growing / "scenes" / f"{name}.npz")
        )
        items, dropped = select_items(cfg, scene_ids, scene_of)
        made, dropped_queries = make_queries(cfg, scene_ids, scene_of)
        queries, databases, twins = render(cfg, growing, scene_ids, items, made, workers)
        _check_not_empty(cfg, items, queries)
        save_rows([i.to_row() for i in items], growing / "selection.parquet")
        save_rows([q.to_row() for q in queries], growing / "retrieval.parquet")
        rows = [{**vars(f), "database": name} for name in databases for f in databases[name]]
        save_rows(rows, growing / "database.parquet")
        counts = _counts(scene_ids, items, queries, databases) | dropped | dropped_queries
        counts |= {
            "queries dropped, target has a twin": len(made) - len(queries),
            "frames left out, twins": twins,
        }
        shortfalls = _shortfalls(cfg, items, queries, databases)
        _finish(cfg, growing, scene_ids, counts, shortfalls)
        growing.rename(folder)
        (folder / PLAN).unlink()


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


def select_items(
    cfg: BenchmarkConfig, scene_ids: dict[str, list[str]], scene_of: Callable[[str], Scene]
) -> tuple[list[SelectionItem], dict[str, int]]:
    """Every selection item, family by family and cell by cell, and how many were dropped for want
    of distractors, by family."""
    track = cfg.selection
    items: list[SelectionItem] = []
    dropped: Counter[str] = Counter()
    for family, quotas in _family_quotas(cfg).items():
        for subtype, quota in quotas.items():
            draw = partial(FAMILY_BUILDERS[family].draft, subtype)
            found, few = drafts.fill(
                subtype, draw, scene_ids, scene_of, quota, cfg.seed, track.min_displacement
            )
            items += found
            dropped[f"items dropped, too alike/{family}"] += few
    return items, dict(dropped)


def make_queries(
    cfg: BenchmarkConfig, scene_ids: dict[str, list[str]], scene_of: Callable[[str], Scene]
) -> tuple[list[RetrievalQuery], dict[str, int]]:
    """Every future-state query, builder by builder, then the counterfactual ones, and how many were
    dropped for want of hard negatives."""
    track = cfg.retrieval
    queries: list[RetrievalQuery] = []
    dropped = 0
    shared = (track.hard_negatives, cfg.selection.min_displacement, cfg.seed)
    for builder, quota in track.builders.items():
        found, few = future.fill(int(builder), scene_ids, scene_of, quota, *shared)
        queries += found
        dropped += few
    found, few = counterfactual.fill(scene_ids, scene_of, track.counterfactual, *shared)
    return [*queries, *found], {"queries dropped, too alike": dropped + few}


def render(
    cfg: BenchmarkConfig,
    folder: Path,
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    workers: int,
) -> tuple[list[RetrievalQuery], dict[str, list[FrameRef]], int]:
    """Render every frame that an item, a query or a database names.

    Returns:
        The queries whose target has pixels of its own, the databases, and how many frames were left
        out of these as twins.
    """
    named = named_frames(cfg, items, queries)
    first = database_frames(queries)
    total = cfg.retrieval.database if first["test"] else 0
    shares = {
        name: share_of_scene(total, len(scene_ids["test"]), k)
        for k, name in enumerate(scene_ids["test"])
    }
    jobs = {
        name: partial(
            _render_one, cfg, folder, name, named[name],
            {base: _frames_of(first[base], name) for base in first}, shares.get(name, 0),
        )
        for name in sorted({*named, *shares})
    }  # fmt: skip
    looked_at = dict(_run_jobs(jobs, "rendering scenes", len(jobs), workers))
    databases, twins = {}, 0
    for base, frames in first.items():
        pixels = {
            FrameRef(name, frame): digest
            for name in sorted(looked_at)
            for frame, digest in looked_at[name][base].items()
        }
        stands_for = distinct(pixels, first=frames)
        databases[base] = sorted({f for f, shown in stands_for.items() if f == shown}, key=astuple)
        twins += len(pixels) - len(databases[base])
        queries = drop_twin_targets(queries, stands_for)
    return queries, databases, twins


def database_frames(queries: list[RetrievalQuery]) -> dict[str, list[FrameRef]]:
    """The frames that each database holds in any case, targets first: the targets of the test
    queries, and for counterfactual ones their hard negatives too."""
    test = {pool: [q for q in queries if q.split == "test" and q.pool == pool] for pool in POOLS}
    asked = [q.target for q in test["counterfactual"]]
    return {
        "test": list(dict.fromkeys(q.target for q in test["future"])),
        "counterfactual": list(
            dict.fromkeys([*asked, *(f for q in test["counterfactual"] for f in q.hard_negatives)])
        ),
    }


def _frames_of(frames: list[FrameRef], name: str) -> list[int]:
    return [f.frame for f in frames if f.scene_id == name]


def _render_one(
    cfg: BenchmarkConfig,
    folder: Path,
    name: str,
    named: set[int],
    first: dict[str, list[int]],
    wanted: int,
) -> dict[str, dict[int, str]]:
    """Render a scene's frames, and give the pixels' hash of those that each database looks at."""
    path = folder / "frames" / f"{name}.zip"
    images = load_frames(path) if path.exists() else {}
    there = len(images)
    scene = load_scene(folder / "scenes" / f"{name}.npz")

    def image_of(frame: int) -> Image.Image:
        if frame not in images:
            images[frame] = renderer(cfg.width, cfg.height).render(scene, frame)
        return images[frame]

    for frame in sorted(named):
        image_of(frame)
    looked_at = {
        base: choose_frames(
            frames, image_of, scene.frames, wanted if base == "test" else 0, cfg.seed, name
        )
        for base, frames in first.items()
    }
    if images and len(images) > there:
        save_frames(images, path)
    return looked_at


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
    with bar, pool(workers) as processes:
        names = {processes.submit(job): name for name, job in jobs.items()}
        try:
            for future_result in as_completed(names):
                yield names[future_result], future_result.result()
                bar.update()
        except BaseException:
            processes.shutdown(wait=False, cancel_futures=True)
            raise


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
    write_atomically(growing / MANIFEST, json.dumps(sealed(manifest), indent=1).encode())


def _counts(
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, int]:
    tally = Counter({f"scenes/{split}": len(names) for split, names in scene_ids.items()})
    tally.update(f"selection/{i.family}/{i.split}" for i in items)
    tally.update(f"retrieval/{_builder(q)}/{q.split}" for q in queries)
    tally.update({f"database/{name}": len(frames) for name, frames in databases.items()})
    return dict(tally)


def _shortfalls(
    cfg: BenchmarkConfig,
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, str]:
    """What every cell, builder and database has, where that is less than its quota."""
    found = Counter((f"{i.family}/{i.subtype}", i.split) for i in items)
    found.update((_builder(q), q.split) for q in queries)
    wanted = {
        **{
            f"{family}/{cell}": quota
            for family, quotas in _family_quotas(cfg).items()
            for cell, quota in quotas.items()
        },
        **{f"builder {b}": quota for b, quota in cfg.retrieval.builders.items()},
        "counterfactual": cfg.retrieval.counterfactual,
    }
    short = {
        f"{cell}/{split}": f"{found[cell, split]} of {getattr(quota, split)}"
        for cell, quota in wanted.items()
        for split in SPLITS
        if found[cell, split] < getattr(quota, split)
    }
    if databases["test"] and len(databases["test"]) < cfg.retrieval.database:
        short["database/test"] = f"{len(databases['test'])} of {cfg.retrieval.database}"
    return short


def _builder(query: RetrievalQuery) -> str:
    return "counterfactual" if query.builder is None else f"builder {query.builder}"


def _family_quotas(cfg: BenchmarkConfig) -> dict[str, dict[str, Quota]]:
    track = cfg.selection
    return {"event": track.event, "time": track.time, "window": track.window}


def check_names(cfg: BenchmarkConfig) -> None:
    """Raises SettingsError where a quota names a cell or builder that does not exist."""
    named = [
        (f"benchmark.selection.{family}", quotas, list(FAMILY_BUILDERS[family].CELLS))
        for family, quotas in _family_quotas(cfg).items()
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
    if problems:
        raise SettingsError("\n".join(problems))


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
    built, asked = flat(store.manifest["config"]), flat(asdict(cfg))
    for key in built | asked:
        old, new = built.get(key), asked.get(key)
        if old != new:
            raise UserError(
                f"{store.folder} was built with benchmark.{key}={old}, you ask for {new}: "
                f"choose another name with benchmark.name=NAME, or delete {store.folder}"
            )


def summary(store: Store) -> str:
    """What a store holds and where it fell short, as a small table."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<36}{count:>8,}" for name, count in store.manifest["counts"].items()]
    for cell, found in store.manifest["shortfalls"].items():
        lines.append(f"  short: {cell} has {found}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
