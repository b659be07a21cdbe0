"""The student's trainer beside TRL's SFTTrainer on a CPU, over the tiny base (extra `bench`).

    python -m benchmarks.speed.sft speed
    python -m benchmarks.speed.sft loss

`speed` trains the tiny benchmark's samples with every variant, each in its own process, in turns.
It prints medians over the rounds of samples per second and peak memory, and of their ratios to
ours. TRL runs with its default settings, with each setting that could help it, and with the
MALLOC_* variables that replace our trainer's call of mallopt. Each loss follows its trainer's own
convention.

`loss` trains over the unquantised base in fp32 and compares the losses of all steps with TRL's; our
trainer then uses TRL's convention, the mean over a micro-batch's tokens and over micro-batches.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.compose import compose
from conf.schema import SftCommand

if TYPE_CHECKING:
    import torch

OVERRIDES = ["+exp=cot", "student=tiny"]
MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 30),
    "MALLOC_TRIM_THRESHOLD_": str((1 << 31) - 1),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
"""The environment variables for what `models.compat.keep_freed_memory` sets in the process."""
OURS, DEFAULT = "ours", "TRL, default settings"
TRL = {"trainer": "trl"}
VARIANTS: dict[str, dict[str, Any]] = {
    OURS: {"micro_batch": 4},
    "ours, activations recomputed": {"micro_batch": 4, "recompute": True},
    DEFAULT: {**TRL, "recompute": True},
    "TRL, activations kept": TRL,
    "TRL, kept, micro-batch 4": {**TRL, "micro_batch": 4},
    "TRL, kept, a worker": {**TRL, "workers": 1},
    "TRL, kept, MALLOC_*": {**TRL, "environment": MALLOC},
    "TRL, kept, 4, MALLOC_*": {**TRL, "micro_batch": 4, "environment": MALLOC},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, steps, measure in (("speed", 8, measure_speed), ("loss", 6, measure_loss)):
        command = commands.add_parser(name)
        command.add_argument("--steps", type=int, default=steps, help="steps after the first")
        command.add_argument("--rounds", type=int, default=3)
        command.add_argument("--store", default="store", help="folder of the built benchmarks")
        command.set_defaults(measure=measure)
    single = commands.add_parser("one", help="one variant; used by the others")
    single.add_argument("variant", type=json.loads)
    single.set_defaults(measure=lambda args: print(json.dumps(train_one(**args.variant))))
    args = parser.parse_args()
    args.measure(args)


def measure_speed(args: argparse.Namespace) -> None:
    rounds = [
        {name: train_in_process(args, name, **variant) for name, variant in VARIANTS.items()}
        for _ in range(args.rounds)
    ]
    print(f"{args.steps} steps of {rounds[0][OURS]['batch']} samples")
    print(f"{'':<34}{'samples/s':>10}{'of ours':>9}{'peak GiB':>10}{'of ours':>9}{'loss':>9}")
    for name in VARIANTS:
        line = f"{name:<34}"
        for key in ("rate", "peak"):
            line += f"{statistics.median(r[name][key] for r in rounds):>10.2f}"
            line += f"{statistics.median(r[name][key] / r[OURS][key] for r in rounds):>9.2f}"
        print(f"{line}{rounds[0][name]['losses'][-1]:>9.4f}", flush=True)
    peers = [name for name, variant in VARIANTS.items() if "trainer" in variant]
    best = max(peers, key=lambda name: statistics.median(r[name]["rate"] for r in rounds))
    for name in (DEFAULT, best):
        ratio = statistics.median(r[OURS]["rate"] / r[name]["rate"] for r in rounds)
        print(f"{ratio:.2f} times {name}", flush=True)


def measure_loss(args: argparse.Namespace) -> None:
    exact = {"precision": "fp32", "quantization": "none"}
    ours = train_in_process(args, OURS, trl_loss=True, **exact)["losses"]
    theirs = train_in_process(args, DEFAULT, **VARIANTS[DEFAULT], **exact)["losses"]
    print(f"{'step':>4}{'ours':>12}{'TRL':>12}{'difference':>12}")
    for step, (loss, other) in enumerate(zip(ours, theirs, strict=True), 1):
        print(f"{step:>4}{loss:>12.6f}{other:>12.6f}{abs(loss - other):>12.1e}")


def train_in_process(args: argparse.Namespace, name: str, **variant: Any) -> dict[str, Any]:
    """The result of `train_one` in a new process."""
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", **variant.pop("environment", {})}
    settings = {"name": name, "steps": args.steps + 1, "store": args.store, **variant}
    command = [sys.executable, "-m", "benchmarks.speed.sft", "one", json.dumps(settings)]
    done = subprocess.run(command, env=environment, text=True, capture_output=True)
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        raise RuntimeError(f"{name} failed")
    return json.loads(done.stdout.splitlines()[-1])


def train_one(
    store: str,
    steps: int,
    precision: str = "auto",
    quantization: str = "nf4",
    trl_loss: bool = False,
    **variant: Any,
) -> dict[str, Any]:
    """Train one variant in this process: samples per second, losses and peak memory in GiB."""
    from torch.utils.data import Subset
    from transformers import set_seed

    from benchmarks.speed import sft_runs
    from data.build import ensure_benchmark
    from models import compat, loading
    from models.precision import resolve_precision
    from teacher.narrate import ensure_rationales
    from train.student.length_sampler import LengthSampler
    from train.student.run import load_datasets

    cfg = compose("train.sft", SftCommand, OVERRIDES)
    cfg.train.precision, cfg.student.quantization = resolve_precision(precision), quantization
    built = ensure_benchmark(cfg.benchmark, Path(store), cfg.workers)
    rationales = ensure_rationales(built, cfg.teacher)
    variant = sft_runs.Variant(**variant)
    if variant.trainer == "ours":
        compat.keep_freed_memory()
    set_seed(sft_runs.SEED)
    model, processor = loading.load_student(cfg.student, cfg.train.precision, list)
    training, _ = load_datasets(cfg, built, rationales)
    lengths = training.lengths(processor.tokenizer, cfg.student.image_size)
    order = islice(LengthSampler(lengths, cfg.train.batch, cfg.seed), steps * cfg.train.batch)
    student = sft_runs.Student(
        model, processor, Subset(training, list(order)), cfg.train, cfg.student.max_length
    )
    options = {}
    if trl_loss:
        options["loss"] = partial(mean_of_means, cfg.train.batch // variant.micro_batch)
    with tempfile.TemporaryDirectory() as folder:
        figures = sft_runs.train(variant, student, steps, Path(folder), **options)
    return {
        "batch": cfg.train.batch,
        "rate": cfg.train.batch * len(figures.seconds) / (sum(figures.seconds) or 1),
        "losses": figures.losses,
        "peak": figures.peak,
    }


def mean_of_means(
    micro_batches: int, outputs: Any, labels: torch.Tensor, num_items_in_batch: Any = None
) -> torch.Tensor:
    """TRL's loss for this model: the mean over a micro-batch's tokens, then over micro-batches."""
    from train.student.trainer import token_mean

    return token_mean(outputs, labels) / micro_batches


if __name__ == "__main__":
    main()
