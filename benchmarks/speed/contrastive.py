"""The retriever's trainer beside plain sentence-transformers, on the same batches of real queries.

    python -m benchmarks.speed.contrastive speed
    python -m benchmarks.speed.contrastive growth

`speed` trains some steps in every variant, each in a process of its own, in turns: medians over the
rounds of queries a second and of the process's peak memory, and of each round's ratio to the plain
library. That gets rows that name what they show, as ours do, so that pixels are read a batch at a
time, its own collator, the best of what its loss offers, and once our attention and our hold on
memory as a gift; the batches are ours. How many of a batch's frames and prefixes are repeated is
told.

The small benchmark's queries hardly share a clip. Where each scene's are all asked after the clip
of its first ("a clip a scene"), the objective is another, and what sharing saves is seen.

`growth` trains on batches of 32, 128 and 512 queries: peak memory, and time a query.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
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
ALONE = {"distinct_frames": False, "shared_prefixes": False}
BY_TOKENS = {"mini_batch_tokens": 3072}
VARIANTS: dict[str, dict[str, Any]] = {
    PLAIN: {"plain": True},
    "plain, by tokens": {"plain": True, **BY_TOKENS},
    "plain, helped": {"plain": True, "helped": True},
    "ours, nothing shared": ALONE,
    "  each frame once": {**ALONE, "distinct_frames": True},
    "  each shared prefix once": {**ALONE, "shared_prefixes": True},
    "  the tower's features reused": {**ALONE, "reuse_features": True},
    "  by tokens": {**ALONE, **BY_TOKENS},
    "  a thread that makes inputs": {**ALONE, "workers": 2},
    "ours, but no features kept": BY_TOKENS,
    "ours, whole": {"reuse_features": True, **BY_TOKENS},
}
SHARING = (
    PLAIN, "ours, nothing shared", "  each frame once", "  each shared prefix once", "ours, whole",
)  # fmt: skip
BATCHES: dict[str, tuple[dict[str, Any], Sequence[str]]] = {
    "train.batches=random": ({"batches": "random"}, tuple(VARIANTS)),
    "train.batches=scenes": ({"batches": "scenes"}, SHARING),
    "train.batches=scenes, a clip a scene": ({"batches": "scenes", "one_clip": True}, SHARING),
}
"""How batches are composed, and the variants to which it matters."""


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
    for rule, (composed, names) in BATCHES.items():
        if args.only is not None:
            names = [PLAIN, *args.only]
        rounds: list[dict[str, dict[str, Any]]] = [{} for _ in range(args.rounds)]
        turns = [(found, name) for found in rounds for name in names]
        for found, name in tqdm(turns, desc=rule, unit="training"):
            found[name] = in_process(args, batch=128, **composed, **VARIANTS[name])
        told = rounds[0][PLAIN]
        print(f"\nbatches of 128 queries, {rule}, {args.steps} steps", flush=True)
        print(
            f"{told['frames']:.0%} of the frames and {told['prefixes']:.0%} of the prefixes that a "
            "batch names are repeated in it"
        )
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
    for name in (PLAIN, "ours, but no features kept", "ours, whole"):
        for batch in (32, 128, 512):
            found = [
                in_process(args, batch=batch, batches="random", **VARIANTS[name])
                for _ in tqdm(range(args.rounds), desc=name, unit="training", leave=False)
            ]
            rate, peak = (statistics.median(f[key] for f in found) for key in ("rate", "peak"))
            print(f"{name:<34}{batch:>6}{rate:>11.2f}{peak:>7.2f}", flush=True)


def in_process(args: argparse.Namespace, **variant: Any) -> dict[str, Any]:
    """What `train_one` gives in a process of its own."""
    told = {
        "steps": args.steps,
        "benchmark": args.benchmark,
        "store": args.store,
        "precision": args.precision,
        **variant,
    }
    command = [sys.executable, "-m", "benchmarks.speed.contrastive", "one", json.dumps(told)]
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
    one_clip: bool = False,
    **switches: Any,
) -> dict[str, Any]:
    """Train a variant here: queries a second, the process's peak memory, the last loss, and the
    shares of a batch's frames and prefixes that are repeated. `helped`: the plain library's trainer
    has our attention and our hold on memory; `one_clip`: a scene's queries are asked after one."""
    from benchmarks.speed.contrastive_runs import repeated, train

    overrides = [f"train.{name}={value}" for name, value in switches.items()]
    cfg = compose(
        "train.contrastive",
        ContrastiveCommand,
        [*OVERRIDES, f"benchmark={benchmark}", f"store={store}", *overrides],
    )
    with tempfile.TemporaryDirectory() as folder:
        figures = train(cfg, steps + 1, plain, helped or not plain, one_clip, Path(folder))
    return {
        "rate": cfg.train.batch * len(figures.seconds) / sum(figures.seconds),
        "peak": figures.peak,
        "loss": figures.losses[-1],
        **repeated(figures.batches),
    }


if __name__ == "__main__":
    main()
