"""Retrievers of the tiny preset on the small benchmark, by how they are trained: untrained, with
in-batch negatives alone, with same-scene hard negatives, with near frames masked, with mined
negatives, and by late interaction; each over three seeds, at every width.

    python -m benchmarks.experiments.retrievers

Trains and measures what is missing, each by the project's own commands and in runs of their own, so
that it may be stopped and started again, and prints one table: means over the seeds, and between
which values they lie. What each measured is kept in benchmarks/ranks/: a run that is kept there is
not made again, and `--table` reads no more than them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.experiments.jobs import run, run_all
from conf.runs import write_text
from evaluation.reporting.rows import RetrievalRow

WAYS: dict[str, list[str]] = {
    "in-batch": ["train.hard_negatives=0"],
    "hard": [],
    "hard-scenes": ["train.batches=scenes"],
    "masked": ["train.batches=scenes", "train.mask_near=24"],
    "mined": ["train.mine_every=40"],
    "late": ["+exp=late_interaction"],
}
MEASURES = ("recall@1", "recall@10", "recall@50", "mrr", "median_rank")


KEPT = Path(__file__).parent / "ranks"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--benchmark", default="small")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", default="checkpoints")
    parser.add_argument("--kept", type=Path, default=KEPT, help="where what was measured is kept")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once, sharing the cores")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="of what is kept")
    args = parser.parse_args()
    plan = Plan(args.benchmark, args.store, Path(args.checkpoints), args.kept)
    seeds = range(args.seeds)
    if not args.table:
        run(["data.build", *plan.where[:2]])
        # Seed by seed, so that a comparison of fewer is there early.
        wanted = [(way, seed) for seed in seeds for way in WAYS]
        run_all(partial(make, plan), [w for w in wanted if not plan.file(*w).exists()], args.jobs)
    print_table(plan, seeds)


@dataclass(frozen=True)
class Plan:
    """What is compared, and where it lies."""

    benchmark: str
    store: str
    checkpoints: Path
    kept: Path

    @property
    def where(self) -> list[str]:
        return [
            f"benchmark={self.benchmark}",
            f"store={self.store}",
            f"checkpoints={self.checkpoints}",
        ]

    def name(self, way: str, seed: int) -> str:
        return f"{self.benchmark}-{way}-{seed}"

    def file(self, way: str, seed: int) -> Path:
        return self.kept / f"{self.name(way, seed)}.json"


def make(plan: Plan, wanted: tuple[str, int], threads: int) -> None:
    """Train and measure one retriever, and keep what was measured over all builders."""
    way, seed = wanted
    name = plan.name(way, seed)
    run(["train.contrastive", *WAYS[way], f"seed={seed}", *plan.where, f"run={name}"], threads)
    measured = plan.checkpoints / "retrieve" / name
    if not (measured / "metrics.json").exists():
        model = f"model={plan.checkpoints / 'contrastive' / name}"
        run(["evaluation.retrieve", model, *plan.where, f"run={name}"], threads)
    rows = json.loads((measured / "report.json").read_text())["rows"]
    plan.kept.mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(row) for row in rows if row["builder"] is None]
    write_text(plan.file(way, seed), "[\n" + ",\n".join(lines) + "\n]\n")


def print_table(plan: Plan, seeds: Sequence[int]) -> None:
    print("\n| negatives | width | " + " | ".join(MEASURES) + " |\n" + "|---" * 7 + "|")
    for way in ("untrained", *WAYS):
        # The preset untrained is measured beside each that is trained, and is the same for all.
        source, used = ("in-batch", seeds[:1]) if way == "untrained" else (way, seeds)
        files = [plan.file(source, seed) for seed in used]
        for same in zip(*(rows_of(f, way == "untrained") for f in files), strict=True):
            cells = [spread([row.measures[name].value for row in same], name) for name in MEASURES]
            print(f"| {way} | {same[0].width} | " + " | ".join(cells) + " |", flush=True)


def rows_of(path: Path, untrained: bool) -> list[RetrievalRow]:
    """A row a width.

    Raises:
        SystemExit: the run has not been made.
    """
    if not path.exists():
        raise SystemExit(f"error: {path} is not there: run without --table, or with fewer --seeds")
    found = [RetrievalRow.from_dict(row) for row in json.loads(path.read_text())]
    return [row for row in found if row.untrained == untrained]


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
