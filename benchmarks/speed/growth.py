r"""Measures how time and memory grow with the amount of work, from a scene to a rank.

    python -m benchmarks.speed.growth
    python -m benchmarks.speed.growth build --sizes 10000 100000 --parallel ray \
        --settings world=falling benchmark.world.objects.{min,max}_count=3 \
        benchmark.world.physics.substeps=5

Each stage doubles one size: the scenes of a build without frames and of its narration, the samples
and the queries of a training step, the frames that a retriever embeds, the frames of a database,
and the ranks of a launcher. Every measurement has a process of its own. The script prints the
seconds of each part of the work and the peak of the resident memory of all processes together, and
their ratios to the previous size: 2 is linear growth. The benchmarks are built in `--folder`.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd
import psutil
from joblib.externals.loky import get_reusable_executor
from tqdm import tqdm

from benchmarks.arguments import positive_int
from benchmarks.speed import comparison, contrastive, retrieval, sft
from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    NarrateCommand,
    Quota,
    RetrieveCommand,
)
from dynapix.data import build
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.items.cells import family_quotas
from dynapix.data.parallel import Workers
from dynapix.data.store import JOURNAL, open_store
from dynapix.models.resolved_settings import resolve_precision
from dynapix.teacher.narrate import narrate_store

BUILD_PARTS = {
    "make_scenes": "scenes",
    "make_items_and_queries": "items and queries",
    "make_databases": "databases",
}
"""Functions of `data.build` that are timed, and the names of their work."""
STEPS = 3
"""Training steps that are timed, after a first one."""

Seconds = dict[str, float]
"""Seconds of each part of the work."""


@dataclass(frozen=True)
class Stage:
    """Work whose size is doubled."""

    unit: str
    """What is counted."""
    sizes: tuple[int, ...]
    measure: Callable[[int, argparse.Namespace], Seconds]
    """Does the work of one size, and returns its seconds."""


@contextmanager
def timed(seconds: Seconds, part: str) -> Iterator[None]:
    """Add the duration of a block to the seconds of a part."""
    start = time.perf_counter()
    yield
    seconds[part] = seconds.get(part, 0.0) + time.perf_counter() - start


def build_scenes(scenes: int, args: argparse.Namespace) -> Seconds:
    """Build the dynapix preset for a number of scenes, without frames."""
    cfg, seconds = scale_preset(scenes, args.settings), {}
    folder = args.folder / cfg.store_name
    if folder.exists():
        raise SystemExit(f"error: {folder} is already built, so it cannot be timed: delete it")

    def with_clock(name: str, part: str) -> Callable[..., Any]:
        function = getattr(build, name)

        def call(*arguments: Any) -> Any:
            with timed(seconds, part):
                return function(*arguments)

        return call

    clocks = {name: with_clock(name, part) for name, part in BUILD_PARTS.items()}
    with patch.multiple(build, **clocks):
        build.build(cfg, folder, Workers(args.workers, args.parallel), strict=True)
    # Otherwise, the process of this measurement waits at its end until idle workers stop.
    get_reusable_executor().shutdown()
    return seconds


def scale_preset(scenes: int, settings: list[str]) -> BenchmarkConfig:
    """Return the dynapix preset with other settings and for another number of scenes. The test
    scenes, the quotas and the sizes of the databases change in proportion."""
    cfg = compose("data.build", BuildCommand, ["benchmark=dynapix", *settings]).benchmark
    share = scenes / cfg.scenes
    cfg.name, cfg.scenes = f"growth-{scenes}", scenes
    cfg.test_scenes = round(share * cfg.test_scenes)

    def scaled(quota: Quota) -> Quota:
        return Quota(round(share * quota.train), round(share * quota.test))

    for quotas in (*family_quotas(cfg).values(), cfg.retrieval.builders):
        for name, quota in quotas.items():
            quotas[name] = scaled(quota)
    cfg.selection.matched = scaled(cfg.selection.matched)
    cfg.retrieval.counterfactual = scaled(cfg.retrieval.counterfactual)
    for key in ("database", "source", "counterfactual_source"):
        setattr(cfg.retrieval, key, round(share * getattr(cfg.retrieval, key)))
    return cfg


def narrate(scenes: int, args: argparse.Namespace) -> Seconds:
    """Write the rationales of the benchmark that `build` has left, with the built-in narrator."""
    folder, seconds = args.folder / scale_preset(scenes, args.settings).store_name, {}
    if not folder.exists():
        raise SystemExit(f"error: {folder} is missing: run the stage build first")
    (folder / JOURNAL).unlink(missing_ok=True)
    store = open_store(folder)
    with timed(seconds, "rationales"):
        narrate_store(store, compose("teacher.narrate", NarrateCommand, []).teacher)
    return seconds


def train_student(batch: int, args: argparse.Namespace) -> Seconds:
    """Train the tiny student with a number of samples per step."""
    precision = f"train.precision={resolve_precision('auto')}"
    settings = ["+exp=cot", "train.generated_items=0", f"store={args.store}", precision]
    variant = sft.Variant((f"batch={batch}",))
    return step_seconds(batch, sft.measure(settings, variant, STEPS, False))


def train_retriever(batch: int, args: argparse.Namespace) -> Seconds:
    """Train the tiny retriever with a number of queries per step."""
    precision = f"train.precision={resolve_precision('auto')}"
    settings = [f"store={args.store}", f"train.batch={batch}", "train.mini_batch=16", precision]
    return step_seconds(batch, contrastive.measure(settings, contrastive.Variant(), STEPS))


def step_seconds(batch: int, measured: comparison.Measurements) -> Seconds:
    return {"step": batch / measured.rate}


def embed(frames: int, args: argparse.Namespace) -> Seconds:
    """Embed frames of the tiny benchmark with the tiny retriever."""
    from dynapix.models.retriever import embedder, inputs

    cfg, seconds = compose("evaluation.retrieve", RetrieveCommand, ["retriever=tiny"]), {}
    store = build.ensure_benchmark(cfg.benchmark, Path(args.store), args.workers)
    database = store.database()
    chosen = (database * -(-frames // len(database)))[:frames]
    reader = FrameReader(store, cfg.retriever.image_size)
    with tempfile.TemporaryDirectory() as folder:
        model = embedder.load_retriever(cfg.retriever, "fp32", [], Path(folder))
        with timed(seconds, "embeddings"):
            inputs.embed(model, chosen, reader, cfg.retriever, cfg.batch)
    return seconds


def rank(frames: int, args: argparse.Namespace) -> Seconds:
    """Rank frames with random embeddings for 500 queries at seven widths."""
    seconds: Seconds = {}
    database = retrieval.embed_frames(range(frames))
    queries, targets = retrieval.embed_queries(frames, 500)
    with timed(seconds, "ranks"):
        retrieval.exact_ranks(queries, database[targets], [database], retrieval.WIDTHS)
    return seconds


def use_ranks(ranks: int, args: argparse.Namespace) -> Seconds:
    """Start an evaluation of the tiny retriever's base, which nothing has embedded, on ranks."""
    seconds: Seconds = {}
    name = compose("evaluation.retrieve", RetrieveCommand, []).benchmark.store_name
    with tempfile.TemporaryDirectory() as folder:
        copy, known = Path(folder, "store", name), shutil.ignore_patterns("embeddings*")
        shutil.copytree(Path(args.store, name), copy, ignore=known)
        launcher = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks), "-m"]
        settings = ["retriever=tiny", f"store={folder}/store", f"checkpoints={folder}/runs"]
        command = [sys.executable, "-m", *launcher, "evaluation.retrieve", *settings]
        with timed(seconds, "retrieval"):
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return seconds


STAGES = {
    "build": Stage("scenes", (250, 500, 1000, 2000), build_scenes),
    "narrate": Stage("scenes", (250, 500, 1000, 2000), narrate),
    "student": Stage("samples", (8, 16, 32, 64), train_student),
    "retriever": Stage("queries", (32, 64, 128, 256), train_retriever),
    "embed": Stage("frames", (500, 1000, 2000, 4000), embed),
    "rank": Stage("frames", (12_500, 25_000, 50_000, 100_000), rank),
    "ranks": Stage("ranks", (1, 2), use_ranks),
}


def measure(stage: str, size: int, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Do the work of a stage at one size, and return a row for each of its parts."""
    logging.basicConfig(level=logging.WARNING)
    with watch_memory() as peak:
        seconds = STAGES[stage].measure(size, args)
    named = {"stage": stage, "size": f"{size:,} {STAGES[stage].unit}"}
    return [{**named, "part": p, "seconds": s, "peak GiB": max(peak)} for p, s in seconds.items()]


@contextmanager
def watch_memory() -> Iterator[list[float]]:
    """Yield a list that gets the resident memory (GiB) of this process and all its children
    together, twice a second until the block ends."""
    finished, sizes, parent = threading.Event(), [0.0], psutil.Process()

    def watch() -> None:
        while not finished.wait(0.5):
            total = 0
            for process in (parent, *parent.children(recursive=True)):
                with suppress(psutil.NoSuchProcess):
                    total += process.memory_info().rss
            sizes.append(total / 2**30)

    threading.Thread(target=watch, daemon=True).start()
    yield sizes
    finished.set()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("stages", nargs="*", choices=["all", *STAGES], default="all")
    parser.add_argument("--sizes", type=positive_int, nargs="+", help="instead of the stage's own")
    parser.add_argument("--folder", type=Path, default=Path("store/growth"))
    parser.add_argument("--store", default="store", help="folder of the built benchmarks")
    parser.add_argument("--workers", type=positive_int, default=2)
    parser.add_argument("--settings", nargs="+", default=[], help="of the benchmark that is built")
    parser.add_argument("--parallel", choices=["loky", "ray"], default="loky")
    args = parser.parse_args()
    for stage in STAGES if "all" in args.stages else args.stages:
        rows: list[dict[str, Any]] = []
        for size in tqdm(args.sizes or STAGES[stage].sizes, desc=stage, unit="measurement"):
            rows += comparison.run_in_process(measure, stage, size, args)
        print_growth(pd.DataFrame(rows))


def print_growth(table: pd.DataFrame) -> None:
    """Print measurements, and their ratios to those of the same part at the previous size."""
    measures = ["seconds", "peak GiB"]
    growth = table[measures] / table.groupby("part")[measures].shift(1)
    table = table.join(growth.add_suffix(", growth"))
    print(table.to_string(index=False, float_format="{:.2f}".format, na_rep=""), flush=True)


if __name__ == "__main__":
    with report_failures():
        main()
