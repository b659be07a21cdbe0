"""The student's trainer beside TRL's SFTTrainer on a CPU, over the tiny base. Needs the extra
`bench`.

    python -m benchmarks.speed.sft speed
    python -m benchmarks.speed.sft loss
    python -m benchmarks.speed.sft start

`speed` trains the tiny benchmark's samples in every variant, each in a process of its own, in
turns: medians over the rounds of samples a second and of the process's peak memory, and of each
round's ratio to ours. TRL is measured as it comes, with each setting that could help it, with the
MALLOC_* variables set, by which its user has what our trainer asks of glibc itself, and on what its
own collator can show, frames as images. The loss is the last step's, by each one's own convention.

`loss` trains over the unquantised base in fp32 and holds the losses of all steps against TRL's,
ours in its convention: the mean over a micro-batch's tokens, and then over micro-batches.

`start` times from the command to the end of its first step, with caches warm.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
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
"""What `models.compat.keep_freed_memory` sets, as a user can before a process starts."""
OURS, DEFAULT = "ours", "TRL as it comes"
PLAIN = {"trainer": "trl"}
VARIANTS: dict[str, dict[str, Any]] = {
    OURS: {"micro_batch": 4},
    "ours, micro-batch 8": {},
    "ours, recomputing": {"micro_batch": 4, "recompute": True},
    DEFAULT: PLAIN | {"recompute": True},
    "TRL, activations kept": PLAIN,
    "TRL, kept, eager attention": PLAIN | {"attention": "eager"},
    "TRL, kept, micro-batch 4": PLAIN | {"micro_batch": 4},
    "TRL, kept, micro-batch 16": PLAIN | {"micro_batch": 16},
    "TRL, kept, a worker": PLAIN | {"workers": 1},
    "TRL, kept, MALLOC_*": PLAIN | {"environment": MALLOC},
    "TRL, kept, eager, MALLOC_*": PLAIN | {"attention": "eager", "environment": MALLOC},
    "TRL, kept, eager, 4, MALLOC_*": PLAIN
    | {"attention": "eager", "micro_batch": 4, "environment": MALLOC},
}
IMAGES: dict[str, dict[str, Any]] = {
    OURS: {"micro_batch": 4},
    DEFAULT: PLAIN | {"recompute": True, "collator": "own"},
    "TRL, activations kept": PLAIN | {"collator": "own"},
    "TRL, kept, eager, MALLOC_*": PLAIN
    | {"collator": "own", "attention": "eager", "environment": MALLOC},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, steps, measure in (
        ("speed", 8, measure_speed),
        ("loss", 6, measure_loss),
        ("start", 1, measure_start),
    ):
        command = commands.add_parser(name)
        command.add_argument("--steps", type=int, default=steps, help="steps that count")
        command.add_argument("--rounds", type=int, default=3)
        command.add_argument("--store", default="store", help="where the tiny benchmark is")
        command.set_defaults(measure=measure)
    single = commands.add_parser("one", help="one variant, for the others")
    single.add_argument("variant", type=json.loads)
    single.set_defaults(measure=print_one)
    args = parser.parse_args()
    args.measure(args)


def measure_speed(args: argparse.Namespace) -> None:
    for title, variants, images in (
        ("Clips as videos, TRL by our collator", VARIANTS, False),
        ("Their frames as images, TRL by its own collator", IMAGES, True),
    ):
        rounds = [
            {
                name: in_process(args, name, switches, images=images)
                for name, switches in variants.items()
            }
            for _ in range(args.rounds)
        ]
        print(f"\n{title}: {args.steps} steps of {rounds[0][OURS]['batch']} samples", flush=True)
        print(f"{'':<34}{'samples/s':>10}{'of ours':>9}{'peak GiB':>10}{'of ours':>9}{'loss':>9}")
        for name in variants:
            print_line(name, rounds)
        peers = [name for name in variants if "trainer" in variants[name]]
        bare = [name for name in peers if "environment" not in variants[name]]
        for what, name in (
            ("as it comes", peers[0]),
            ("at its best without MALLOC_*", max(bare, key=partial(rate, rounds))),
            ("at its best", max(peers, key=partial(rate, rounds))),
        ):
            times = statistics.median(r[OURS]["rate"] / r[name]["rate"] for r in rounds)
            print(f"{times:.2f} times TRL {what} ({name})", flush=True)


def rate(rounds: list[dict[str, Any]], name: str) -> float:
    return statistics.median(r[name]["rate"] for r in rounds)


def print_line(name: str, rounds: list[dict[str, Any]]) -> None:
    """A variant's medians, and those of its share of ours in each round."""
    line = f"{name:<34}"
    for key, width in (("rate", 10), ("peak", 10)):
        line += f"{statistics.median(r[name][key] for r in rounds):>{width}.2f}"
        line += f"{statistics.median(r[name][key] / r[OURS][key] for r in rounds):>9.2f}"
    print(f"{line}{rounds[0][name]['losses'][-1]:>9.4f}", flush=True)


def measure_loss(args: argparse.Namespace) -> None:
    exact = {"precision": "fp32", "quantization": "none"}
    mine = in_process(args, OURS, {}, convention="trl", **exact)["losses"]
    theirs = in_process(args, DEFAULT, VARIANTS[DEFAULT], **exact)["losses"]
    print(f"{'step':>4}{'ours':>12}{'TRL':>12}{'apart':>12}")
    for step, (loss, other) in enumerate(zip(mine, theirs, strict=True), 1):
        print(f"{step:>4}{loss:>12.6f}{other:>12.6f}{abs(loss - other):>12.1e}")


def measure_start(args: argparse.Namespace) -> None:
    ways = {
        "ours, which first measures 64 items a mode": partial(start_ours, args.store, 64),
        "ours, measuring one item a mode": partial(start_ours, args.store, 1),
        DEFAULT: partial(start_trls, args.store),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    # The first round warms the caches.
    for _ in range(args.rounds + 1):
        for name, way in ways.items():
            times[name].append(way())
    print("from the command to the end of its first step, s")
    for name, found in times.items():
        print(f"{name:<46}{statistics.median(found[1:]):>8.1f}")


def start_ours(store: str, measured: int) -> float:
    """Seconds until `train.sft` has its first step in its journal."""
    with tempfile.TemporaryDirectory() as folder:
        settings = [*OVERRIDES, f"store={store}", f"checkpoints={folder}", "run=first"]
        settings += ["train.max_steps=1", "train.evaluations=1"]
        settings += [f"train.validation_items={measured}"]
        journal = Path(folder) / "sft" / "first" / "metrics.jsonl"
        with started([sys.executable, "-m", "train.sft", *settings]) as (process, since):
            while not (journal.exists() and '"loss"' in journal.read_text()):
                if process.poll():
                    raise RuntimeError("train.sft has failed")
                time.sleep(0.01)
            return time.perf_counter() - since


def start_trls(store: str) -> float:
    """Seconds until TRL, given the same samples, has trained for a step."""
    variant = {"name": DEFAULT, "steps": 1, "store": store, **VARIANTS[DEFAULT]}
    with started(one(variant)) as (process, since):
        if not any(line.startswith("{") for line in process.stdout or ()):
            raise RuntimeError("TRL has failed")
        return time.perf_counter() - since


@contextmanager
def started(command: list[str]) -> Iterator[tuple[subprocess.Popen[str], float]]:
    """A process that ends with the block, and when it was started. Nothing that it says but an
    error is shown."""
    with tempfile.TemporaryFile("w+") as said:
        since = time.perf_counter()
        process = subprocess.Popen(
            command, env=environment({}), text=True, stdout=subprocess.PIPE, stderr=said
        )
        try:
            yield process, since
        except RuntimeError:
            said.seek(0)
            print(said.read(), file=sys.stderr)
            raise
        finally:
            process.kill()
            process.wait()


def in_process(
    args: argparse.Namespace, name: str, switches: dict[str, Any], **settings: Any
) -> dict[str, Any]:
    """What `train_one` gives in a process of its own."""
    variant = {"name": name, "steps": args.steps + 1, "store": args.store, **switches, **settings}
    done = subprocess.run(
        one(variant),
        env=environment(switches.get("environment", {})),
        text=True,
        capture_output=True,
    )
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        raise RuntimeError(f"{name} has failed")
    return json.loads(done.stdout.splitlines()[-1])


def one(variant: dict[str, Any]) -> list[str]:
    """The command that trains a variant in a process of its own."""
    return [sys.executable, "-m", "benchmarks.speed.sft", "one", json.dumps(variant)]


def environment(own: dict[str, str]) -> dict[str, str]:
    return {**os.environ, "HF_HUB_OFFLINE": "1", **own}


def print_one(args: argparse.Namespace) -> None:
    print(json.dumps(train_one(**args.variant)), flush=True)


def train_one(
    store: str,
    steps: int,
    images: bool = False,
    precision: str = "auto",
    quantization: str = "nf4",
    convention: str = "ours",
    **switches: Any,
) -> dict[str, Any]:
    """Train a variant here: samples a second and a step, losses, and the process's peak memory."""
    from torch.utils.data import Subset
    from transformers import set_seed

    from benchmarks.speed import sft_runs
    from data.build import ensure_benchmark
    from models import compat, loading
    from models.precision import resolve_precision
    from teacher.narrate import ensure_rationales
    from train.student.length_sampler import LengthSampler
    from train.student.run import load_datasets

    variant = sft_runs.Variant(**switches)
    cfg = compose("train.sft", SftCommand, OVERRIDES)
    cfg.train.precision, cfg.student.quantization = resolve_precision(precision), quantization
    built = ensure_benchmark(cfg.benchmark, Path(store), cfg.workers)
    rationales = ensure_rationales(built, cfg.teacher)
    if variant.trainer == "ours":
        compat.keep_freed_memory()
    set_seed(sft_runs.SEED)
    model, processor = loading.load_student(cfg.student, cfg.train.precision, list)
    training, _ = load_datasets(cfg, built, rationales)
    lengths = training.lengths(processor.tokenizer, cfg.student.image_size)
    order = islice(LengthSampler(lengths, cfg.train.batch, cfg.seed), steps * cfg.train.batch)
    shown = sft_runs.AsImages(training) if images else training
    work = sft_runs.Work(
        model, processor, Subset(shown, list(order)), cfg.train, cfg.student.max_length
    )
    settings = {}
    if convention == "trl":
        settings["loss"] = partial(mean_of_means, cfg.train.batch // variant.micro_batch)
    with tempfile.TemporaryDirectory() as folder:
        figures = sft_runs.run(variant, work, steps, Path(folder), **settings)
    return {
        "batch": cfg.train.batch,
        "rate": cfg.train.batch * len(figures.seconds) / (sum(figures.seconds) or 1),
        "losses": figures.losses,
        "peak": figures.peak,
    }


def mean_of_means(
    micro_batches: int, outputs: Any, labels: torch.Tensor, num_items_in_batch: Any = None
) -> torch.Tensor:
    """TRL's loss for this model: the mean over a micro-batch's supervised tokens, and over the
    micro-batches of a step."""
    from train.student.trainer import token_mean

    return token_mean(outputs, labels) / micro_batches


if __name__ == "__main__":
    main()
