"""Lists the files that a reader follows through a command.

    python -m benchmarks.reading_path            # all walks
    python -m benchmarks.reading_path train.sft

    data.build           from its main function to a selection item
    train.sft            from its main function to the first gradient
    train.contrastive    the same
    evaluation.select    from its main function to a number in the report

Runs each command in one process on a small benchmark, and prints the files of the project in which
a function is executed, in the order of the first execution.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from importlib import import_module
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType
from typing import Any
from unittest.mock import patch

import torch

from dynapix.conf import schema
from dynapix.conf.compose import compose, config_name
from dynapix.conf.runs import Run, open_run
from dynapix.data.build import ensure_benchmark
from dynapix.data.parallel import Job, Workers
from dynapix.data.store import save_rows
from dynapix.teacher.narrate import ensure_rationales

ROOT = Path(__file__).resolve().parent.parent
QUERIES = {1: 64, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0}
"""Number of queries of each builder."""
BENCHMARK = (
    "benchmark=tiny", "benchmark.scenes=60", "benchmark.retrieval.database=0", "workers=1",
    *(f"benchmark.retrieval.builders.{k}={{train:{n},test:0}}" for k, n in QUERIES.items()),
    "benchmark.retrieval.counterfactual={train:0,test:0}",
)  # fmt: skip
"""A benchmark whose scenes do not suffice for all quotas of items."""
TRAINING = ("+exp=cot", "train.max_steps=1", "train.evaluations=1", "train.generated_items=0")
RETRIEVER = ("train.max_steps=1", "train.batch=16", "train.mini_batch=8")
EVALUATION = ("student=tiny", "modes=[record]", "limit=4")
WALKS = ("data.build", "train.sft", "train.contrastive", "evaluation.select")
GRADIENT = torch.Tensor.backward.__code__


class Arrived(BaseException):
    """The walk is at its end."""


def walk(act: Callable[[], Any], end: CodeType | None = None) -> list[str]:
    """Return the project's files in which `act` executes a function until it calls `end`."""
    files: dict[str, None] = {}

    def record(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code is end:
            raise Arrived
        # The body of a module or class is no function, and has no fast locals.
        if event == "call" and code.co_flags & CO_OPTIMIZED:
            files[code.co_filename] = None

    try:
        sys.setprofile(record)
        act()
    except Arrived:
        pass
    finally:
        sys.setprofile(None)
    inside = (Path(name) for name in files if name.startswith(str(ROOT)) and ".venv" not in name)
    return [path.relative_to(ROOT).as_posix() for path in inside if path != Path(__file__)]


def prepare(name: str, settings_type: type, overrides: tuple[str, ...]) -> Callable[[], Any]:
    """Return a function that runs a command's main function and writes its metrics."""
    cfg = compose(name, settings_type, [*overrides, "run=walk"])
    run = Run("walk", Path(cfg.checkpoints, config_name(name), "walk"), overrides)
    run.folder.mkdir(parents=True)
    open_run(run, asdict(cfg), name)
    main = import_module(f"dynapix.{name}").main

    def act() -> None:
        if (metrics := main.__wrapped__(cfg, run)) is not None:
            (run.folder / "metrics.json").write_text(json.dumps(metrics))

    return act


def run_inline(_: Workers, jobs: Mapping[str, Job], *rest: Any) -> Iterator[tuple[str, Any]]:
    """Replace `Workers.run`: run the jobs in this process, where they can be traced."""
    return ((name, job()) for name, job in jobs.items())


def walk_all(folder: str) -> Iterator[tuple[str, list[str]]]:
    """Yield each walk's name and files, in a folder for the benchmark and the runs."""
    places = (f"store={folder}/store", f"checkpoints={folder}/checkpoints")
    shared = (*BENCHMARK, *places)
    with patch.object(Workers, "run", run_inline):
        build = prepare("data.build", schema.BuildCommand, shared)
        yield "data.build", walk(build, save_rows.__code__)
        build()
    sft = ("train.sft", schema.SftCommand, (*shared, *TRAINING))
    # The walk through the trainer begins with a built benchmark and its rationales.
    settings = compose(*sft)
    store = ensure_benchmark(settings.benchmark, Path(settings.store), settings.workers)
    ensure_rationales(store, settings.teacher)
    yield "train.sft", walk(prepare(*sft), GRADIENT)
    contrastive = ("train.contrastive", schema.ContrastiveCommand, (*shared, *RETRIEVER))
    yield "train.contrastive", walk(prepare(*contrastive), GRADIENT)
    select = prepare("evaluation.select", schema.SelectCommand, (*shared, *EVALUATION))
    report = prepare("evaluation.report", schema.ReportCommand, places)
    yield "evaluation.select", [*dict.fromkeys([*walk(select), *walk(report)])]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("walks", nargs="*", choices=["all", *WALKS], default="all")
    asked = parser.parse_args().walks
    with tempfile.TemporaryDirectory() as folder:
        for name, files in walk_all(folder):
            if name in asked or "all" in asked:
                print(name, *(f"  {file}" for file in files), f"{len(files)} files", sep="\n")
