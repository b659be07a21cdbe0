"""Measures the time and memory of building benchmarks, without rendering their frames.

    python -m benchmarks.speed.build 100 1000 10000

For each number of scenes, the dynapix preset with proportional quotas is built in three stages:
scenes with their oracle, items and queries, databases. The script prints the seconds of each stage,
the number of scenes per second and worker, and the peak of the resident memory of all processes
together (GiB). The benchmarks are built in `--folder`. An interrupted build resumes; the
measurements then cover only the remaining work.
"""

from __future__ import annotations

import argparse
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd
import psutil

from benchmarks.arguments import positive_int
from conf.compose import compose
from conf.failures import report_failures
from conf.schema import BenchmarkConfig, BuildCommand, Quota
from data import build
from data.checks.counts import summarize_store
from data.items.cells import family_quotas
from data.parallel import Workers
from data.store import open_store

PAPER_SCENES = 10_000
STAGES = ("make_scenes", "make_items_and_queries", "make_databases")
"""Names of the functions of `data.build` that run the stages. `measure` replaces them with timed
versions."""


def scale_preset(scenes: int) -> BenchmarkConfig:
    """Return the dynapix preset for another number of scenes. The quotas and the sizes of the
    standard test and of the databases change in proportion."""
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


def watch_memory(row: dict[str, float], finished: threading.Event) -> None:
    """Until `finished` is set, keep the peak of the resident memory of this process and all its
    children together in `row`."""
    parent = psutil.Process()
    while not finished.wait(0.5):
        total = 0
        for process in (parent, *parent.children(recursive=True)):
            with suppress(psutil.NoSuchProcess):
                total += process.memory_info().rss
        row["peak GiB"] = max(row["peak GiB"], total / 2**30)


def measure(scenes: int, folder: Path, workers: int) -> dict[str, float]:
    """Build a benchmark, print its numbers of records, and return the measurements."""
    cfg = scale_preset(scenes)
    if (folder / cfg.name).exists():
        raise SystemExit(
            f"error: {folder / cfg.name} is already built, so its build cannot be timed: delete it"
        )
    row = {"scenes": scenes, "peak GiB": 0.0}
    finished = threading.Event()
    threading.Thread(target=watch_memory, args=[row, finished], daemon=True).start()

    def timed(name: str) -> Callable[..., Any]:
        stage = getattr(build, name)

        def call(*args: Any) -> Any:
            start = time.perf_counter()
            result = stage(*args)
            row[f"{name}, s"] = time.perf_counter() - start
            return result

        return call

    with patch.multiple(build, **{name: timed(name) for name in STAGES}):
        build.build(cfg, folder / cfg.name, Workers(workers), strict=True)
    finished.set()
    store = open_store(folder / cfg.name)
    print(summarize_store(store))
    row["counterfactual"] = len(list(store.folder.glob("scenes/*-without-*.npz")))
    row["scenes/s/worker"] = (scenes + row["counterfactual"]) / row["make_scenes, s"] / workers
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", type=positive_int, nargs="+")
    parser.add_argument("--folder", type=Path, default=Path("store/growth"))
    parser.add_argument("--workers", type=positive_int, default=2)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    rows = [measure(scenes, options.folder, options.workers) for scenes in options.scenes]
    print(f"\n{options.workers} workers; the rate includes counterfactual scenes")
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.1f}".format))


if __name__ == "__main__":
    with report_failures():
        main()
