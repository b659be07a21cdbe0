"""The time and memory of building a benchmark without frames, by number of scenes.

    python -m benchmarks.speed.build 100 1000 10000

For each number of scenes, the dynapix preset is built with proportional quotas in three stages:
scenes with their oracle, items and queries, databases. Prints the seconds of each stage, scenes per
second and worker, and the peak memory of all processes together. An interrupted build resumes in
FOLDER (store/growth), so only an uninterrupted build is measured correctly.
"""

from __future__ import annotations

import argparse
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import psutil

from conf.compose import compose
from conf.schema import BenchmarkConfig, BuildCommand, Quota
from data.build import lock_partial_build
from data.parallel import Workers
from data.store import load_scene, scene_path
from data.tracks.build_items import family_quotas, make_items_and_queries
from data.tracks.retrieval.database import make_databases
from data.tracks.shortfalls import count_records, find_shortfalls
from data.world.scenes import make_scenes

PAPER_SCENES = 10_000


def scale_preset(scenes: int) -> BenchmarkConfig:
    """The dynapix preset for another number of scenes, with proportional quotas and databases."""
    cfg = compose("data.build", BuildCommand, ["benchmark=dynapix"]).benchmark
    cfg.name, cfg.scenes, share = f"growth-{scenes}", scenes, scenes / PAPER_SCENES

    def scaled(quota: Quota) -> Quota:
        return Quota(round(share * quota.train), round(share * quota.test))

    for quotas in (*family_quotas(cfg).values(), cfg.retrieval.builders):
        for name, quota in quotas.items():
            quotas[name] = scaled(quota)
    cfg.selection.matched = scaled(cfg.selection.matched)
    cfg.retrieval.counterfactual = scaled(cfg.retrieval.counterfactual)
    for key in ("standard", "database", "source", "counterfactual_source"):
        setattr(cfg.retrieval, key, round(share * getattr(cfg.retrieval, key)))
    return cfg


class MemoryMonitor:
    """Samples the memory (GiB) of this process and its children and keeps the maximum."""

    def __init__(self) -> None:
        self.peak_gib = 0.0
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        own = psutil.Process()
        while True:
            total = 0
            for process in (own, *own.children(recursive=True)):
                try:
                    total += process.memory_info().rss
                except psutil.NoSuchProcess:
                    continue
            self.peak_gib = max(self.peak_gib, total / 2**30)
            time.sleep(0.5)


@contextmanager
def timed(times: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    times[stage] = time.perf_counter() - start


def measure(scenes: int, folder: Path, workers: int) -> str:
    cfg, pool, memory = scale_preset(scenes), Workers(workers), MemoryMonitor()
    times: dict[str, float] = {}
    with lock_partial_build(cfg, folder / cfg.name) as partial:
        with timed(times, "scenes"):
            scene_ids, _ = make_scenes(cfg, partial, pool, strict=True)
        with timed(times, "items"):
            items, queries, dropped = make_items_and_queries(cfg, partial, scene_ids, pool)
        with timed(times, "databases"):
            scene_of = lru_cache(maxsize=None)(lambda name: load_scene(scene_path(partial, name)))
            queries, databases, left_out = make_databases(cfg, queries, scene_ids, scene_of)
    counts = count_records(scene_ids, items, queries, databases) | dropped | left_out
    shortfalls = find_shortfalls(cfg, items, queries, databases)
    print("\n".join(f"  {name:<40}{count:>8,}" for name, count in counts.items()))
    print("\n".join(f"  below its quota: {cell} has {count}" for cell, count in shortfalls.items()))
    counterfactual = len(list(partial.glob("scenes/*-without-*.npz")))
    rate = (scenes + counterfactual) / times["scenes"] / workers
    row = "".join(f"{times[stage]:>11.1f}" for stage in ("scenes", "items", "databases"))
    return f"{scenes:>8,}{counterfactual:>16,}{row}{rate:>14.1f}{memory.peak_gib:>10.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=int, nargs="+")
    parser.add_argument("--folder", type=Path, default=Path("store/growth"))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    rows = [measure(scenes, options.folder, options.workers) for scenes in options.scenes]
    print(
        f"\n{options.workers} workers; seconds per stage; rate of scenes with counterfactual ones"
    )
    head = f"{'scenes':>8}{'counterfactual':>16}{'scenes':>11}{'items':>11}{'databases':>11}"
    print(head + f"{'scenes/s/core':>14}{'peak GiB':>10}")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
