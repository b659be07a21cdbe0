"""The retriever's trainer beside plain sentence-transformers, on the same batches of real queries.

    python -m benchmarks.speed.contrastive speed
    python -m benchmarks.speed.contrastive growth

`speed` trains some steps in every variant, each in its own process, in turns. It prints
medians over the rounds of queries a second and of the process's peak memory, and of each round's
ratio to the plain library. The plain library gets rows that name queries too, so that it reads
pixels batch by batch, its own collator, its loss's mini-batches by tokens, and, in one variant,
this project's attention and memory settings.

`growth` trains on batches of 32, 128 and 512 queries: peak memory and queries a second.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tqdm import tqdm

from conf.compose import compose
from conf.schema import ContrastiveCommand

OVERRIDES = [
    "retriever=tiny",
    "retriever.architecture=null",
    "retriever.model=checkpoints/bases/tiny",
    "retriever.quantization=nf4",
    "retriever.lora.rank=16",
    "retriever.image_size=128",
    "retriever.max_length=2048",
    "retriever.widths=[192,128,64,32]",
    "train.hard_negatives=1",
    "train.mini_batch=16",
]
PLAIN = "plain sentence-transformers"
VARIANTS: dict[str, dict[str, Any]] = {
    PLAIN: {"plain": True},
    "plain, by tokens": {"plain": True, "plain_tokens": 3072},
    "plain, helped": {"plain": True, "helped": True},
    "ours": {},
    "  with inputs loaded ahead": {"workers": 2},
    "ours, with reused features": {"reuse_features": True},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(required=True)
    for name, measure in (("speed", measure_speed), ("growth", measure_growth)):
        command = commands.add_parser(name)
        command.add_argument("--steps", type=int, default=3, help="steps that count, after one")
        command.add_argument("--rounds", type=int, default=3)
        command.add_argument("--benchmark", default="small")
        command.add_argument("--store", default="store", help="where the benchmark is or is built")
        command.add_argument("--precision", default="fp32", help="also bf16, of all variants")
        command.set_defaults(measure=measure)
        if name == "speed":
            command.add_argument("--only", nargs="*", help="these variants, beside the plain one")
    single = commands.add_parser("one", help="one variant, for the others")
    single.add_argument("variant", type=json.loads)
    single.set_defaults(measure=print_one)
    args = parser.parse_args()
    args.measure(args)


def measure_speed(args: argparse.Namespace) -> None:
    names = list(VARIANTS) if args.only is None else [PLAIN, *args.only]
    rounds: list[dict[str, dict[str, Any]]] = [{} for _ in range(args.rounds)]
    turns = [(results, name) for results in rounds for name in names]
    for results, name in tqdm(turns, unit="training"):
        results[name] = in_process(args, batch=128, **VARIANTS[name])
    print(f"\nbatches of 128 queries, {args.steps} steps", flush=True)
    print(f"{'':<34}{'queries/s':>10}{'of plain':>10}{'GiB':>7}{'of plain':>10}{'loss':>10}")
    for name in names:
        line = f"{name:<34}"
        for key, width in (("rate", 10), ("peak", 7)):
            line += f"{statistics.median(r[name][key] for r in rounds):>{width}.2f}"
            ratio = statistics.median(r[name][key] / r[PLAIN][key] for r in rounds)
            line += f"{ratio:>10.2f}"
        print(f"{line}{rounds[0][name]['loss']:>10.4f}", flush=True)


def measure_growth(args: argparse.Namespace) -> None:
    print(f"{'':<34}{'batch':>6}{'queries/s':>11}{'GiB':>7}")
    for name in (PLAIN, "ours", "ours, with reused features"):
        for batch in (32, 128, 512):
            results = [
                in_process(args, batch=batch, **VARIANTS[name])
                for _ in tqdm(range(args.rounds), desc=name, unit="training", leave=False)
            ]
            rate, peak = (statistics.median(r[key] for r in results) for key in ("rate", "peak"))
            print(f"{name:<34}{batch:>6}{rate:>11.2f}{peak:>7.2f}", flush=True)


def in_process(args: argparse.Namespace, **variant: Any) -> dict[str, Any]:
    """The result of `train_one` in a new process."""
    variant = {
        "steps": args.steps,
        "benchmark": args.benchmark,
        "store": args.store,
        "precision": args.precision,
        **variant,
    }
    command = [sys.executable, "-m", "benchmarks.speed.contrastive", "one", json.dumps(variant)]
    done = subprocess.run(command, text=True, capture_output=True)
    if done.returncode:
        print(done.stderr, file=sys.stderr)
        raise RuntimeError(f"{variant} has failed")
    return json.loads(done.stdout.splitlines()[-1])


def print_one(args: argparse.Namespace) -> None:
    print(json.dumps(train_one(**args.variant)), flush=True)


def train_one(
    steps: int,
    benchmark: str,
    store: str,
    plain: bool = False,
    helped: bool = False,
    plain_tokens: int | None = None,
    **switches: Any,
) -> dict[str, Any]:
    """Train a variant in this process: queries a second, the process's peak memory and the last
    loss. With `helped`, the plain library has this project's attention and memory settings."""
    from benchmarks.speed.contrastive_runs import train

    overrides = [f"train.{name}={value}" for name, value in switches.items()]
    cfg = compose(
        "train.contrastive",
        ContrastiveCommand,
        [*OVERRIDES, f"benchmark={benchmark}", f"store={store}", *overrides],
    )
    with tempfile.TemporaryDirectory() as folder:
        helped = helped or not plain
        figures = train(cfg, steps + 1, plain, helped, plain_tokens, Path(folder))
    return {
        "rate": cfg.train.batch * len(figures.seconds) / sum(figures.seconds),
        "peak": figures.peak,
        "loss": figures.losses[-1],
    }


if __name__ == "__main__":
    main()
