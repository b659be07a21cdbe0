"""Retrievers of the tiny preset on the small benchmark, by how they are trained: untrained, with
in-batch negatives alone, with same-scene hard negatives, with near frames masked, with mined
negatives, and by late interaction; each over three seeds, at every width.

    python -m benchmarks.retrievers

Trains and measures what is missing, each by the project's own commands and in runs of their own, so
that it may be stopped and started again, and prints one table: means over the seeds, and between
which values they lie.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.jobs import run, run_all
from evaluation.tables import RetrievalRow

WAYS: dict[str, list[str]] = {
    "in-batch": ["train.hard_negatives=0"],
    "hard": [],
    "hard-scenes": ["train.batches=scenes"],
    "masked": ["train.batches=scenes", "train.mask_near=24"],
    "mined": ["train.mine_every=40"],
    "late": ["+exp=late_interaction"],
}
MEASURES = ("recall@1", "recall@10", "recall@50", "mrr", "median_rank")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--benchmark", default="small")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", default="checkpoints")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once, sharing the cores")
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    where = [
        f"benchmark={args.benchmark}", f"store={args.store}", f"checkpoints={args.checkpoints}"
    ]  # fmt: skip
    run(["data.build", *where[:2]])
    seeds = range(args.seeds)
    # Seed by seed, so that a comparison of fewer is there early.
    wanted = [(way, seed) for seed in seeds for way in WAYS]
    run_all(partial(make, args.benchmark, where, Path(args.checkpoints)), wanted, args.jobs)
    print_table(args.benchmark, Path(args.checkpoints), seeds)


def make(
    benchmark: str, where: list[str], checkpoints: Path, wanted: tuple[str, int], threads: int
) -> None:
    """Train and measure one retriever."""
    way, seed = wanted
    name = f"{benchmark}-{way}-{seed}"
    run(["train.contrastive", *WAYS[way], f"seed={seed}", *where, f"run={name}"], threads)
    if not (checkpoints / "retrieve" / name / "metrics.json").exists():
        model = f"model={checkpoints / 'contrastive' / name}"
        run(["evaluation.retrieve", model, *where, f"run={name}"], threads)


def print_table(benchmark: str, checkpoints: Path, seeds: Sequence[int]) -> None:
    print("\n| negatives | width | " + " | ".join(MEASURES) + " |\n" + "|---" * 7 + "|")
    for way in ("untrained", *WAYS):
        # The preset untrained is measured beside each that is trained, and is the same for all.
        source, used = ("in-batch", seeds[:1]) if way == "untrained" else (way, seeds)
        folders = [checkpoints / "retrieve" / f"{benchmark}-{source}-{seed}" for seed in used]
        for same in zip(*(rows_of(f, way == "untrained") for f in folders), strict=True):
            cells = [spread([row.measures[name].value for row in same], name) for name in MEASURES]
            print(f"| {way} | {same[0].width} | " + " | ".join(cells) + " |", flush=True)


def rows_of(folder: Path, untrained: bool) -> list[RetrievalRow]:
    """Over all builders, a row a width."""
    rows = json.loads((folder / "report.json").read_text())["rows"]
    found = [RetrievalRow.from_dict(row) for row in rows]
    return [row for row in found if row.builder is None and row.untrained == untrained]


def spread(values: Sequence[float], name: str) -> str:
    """A mean with its least and greatest, shares in percent."""
    scale = 100 if name.startswith("recall") else 1
    shown = [scale * f(values) for f in (np.mean, min, max)]
    digits = 3 if name == "mrr" else 1
    if len(values) == 1:
        return f"{shown[0]:.{digits}f}"
    return "{:.{d}f} [{:.{d}f}, {:.{d}f}]".format(*shown, d=digits)


if __name__ == "__main__":
    main()
