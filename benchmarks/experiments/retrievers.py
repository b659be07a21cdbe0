"""The tiny retriever trained in several ways on the small benchmark: in-batch negatives, same-scene
hard negatives, mined negatives and late interaction, three seeds each, at every width.

    python -m benchmarks.experiments.retrievers            # train and evaluate what is missing
    python -m benchmarks.experiments.retrievers --table    # print the recorded results

Results are recorded in `ranks.parquet`, one row per run and width. A run that is recorded is not
trained again. The table holds means over the seeds with the least and the greatest value. It also
holds variants whose settings no longer exist: `hard-scenes` composed batches scene by scene, and
`masked` masked near-identical frames in such batches.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from threading import Lock

import pandas as pd

from benchmarks.experiments.jobs import run, run_all
from evaluation.reporting.results import RetrievalResult

RANKS = Path(__file__).with_name("ranks.parquet")
VARIANTS: dict[str, list[str]] = {
    "in-batch": ["train.hard_negatives=0"],
    "hard": [],
    "mined": ["train.mine_every=40"],
    "late": ["+exp=late_interaction"],
}
"""Overrides of `train.contrastive`; without any it takes one same-scene hard negative a query."""
MEASURES = {"recall@1": 1, "recall@10": 1, "recall@50": 1, "mrr": 3, "median_rank": 1}
"""The printed measures and their decimals; recalls are in percent."""
WRITING = Lock()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--benchmark", default="small")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", default="checkpoints")
    parser.add_argument("--ranks", type=Path, default=RANKS, help="table of recorded results")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time; they share the cores")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="only print the recorded results")
    args = parser.parse_args()
    experiment = Experiment(args.benchmark, args.store, Path(args.checkpoints), args.ranks)
    if not args.table:
        run(["data.build", *experiment.shared[:2]])
        jobs = [(variant, seed) for seed, variant in product(range(args.seeds), VARIANTS)]
        run_all(partial(train_and_evaluate, experiment), experiment.missing(jobs), args.jobs)
    print_table(experiment.recorded(args.seeds))


@dataclass(frozen=True)
class Experiment:
    """The compared runs and the table that records their results."""

    benchmark: str
    store: str
    checkpoints: Path
    ranks: Path

    @property
    def shared(self) -> list[str]:
        return [
            f"benchmark={self.benchmark}", f"store={self.store}",
            f"checkpoints={self.checkpoints}",
        ]  # fmt: skip

    def missing(self, jobs: list[tuple[str, int]]) -> list[tuple[str, int]]:
        """The jobs whose results are not recorded."""
        table = self.recorded()
        done = set(zip(table.variant, table.seed, strict=True))
        return [job for job in jobs if job not in done]

    def recorded(self, seeds: int | None = None) -> pd.DataFrame:
        """The recorded results of this benchmark, of the first `seeds` seeds."""
        table = pd.read_parquet(self.ranks)
        table = table[table.benchmark == self.benchmark]
        return table if seeds is None else table[table.seed < seeds]


def train_and_evaluate(experiment: Experiment, job: tuple[str, int], threads: int) -> None:
    """Train and evaluate one retriever, and record its results over all builders."""
    variant, seed = job
    name = f"{experiment.benchmark}-{variant}-{seed}"
    shared = [*experiment.shared, f"run={name}"]
    run(["train.contrastive", *VARIANTS[variant], f"seed={seed}", *shared], threads)
    evaluated = experiment.checkpoints / "retrieve" / name
    if not (evaluated / "metrics.json").exists():
        model = experiment.checkpoints / "contrastive" / name
        run(["evaluation.retrieve", f"model={model}", *shared], threads)
    report = json.loads((evaluated / "report.json").read_text())
    results = [RetrievalResult.from_dict(row) for row in report["rows"] if row["builder"] is None]
    rows = [
        {
            "benchmark": experiment.benchmark, "variant": variant, "seed": seed,
            "untrained": result.untrained, "width": result.width,
            **{name: result.measures[name].value for name in MEASURES},
            "queries": result.queries, "frames": result.frames, "bytes": result.bytes,
            "seconds": result.seconds,
        }
        for result in results
    ]  # fmt: skip
    with WRITING:
        table = pd.concat([pd.read_parquet(experiment.ranks), pd.DataFrame(rows)])
        table.to_parquet(experiment.ranks, index=False, compression="zstd")


def print_table(table: pd.DataFrame) -> None:
    if table.empty:
        raise SystemExit("error: no results are recorded: run without --table")
    # Every run also measures the untrained preset, which is the same in all of them.
    untrained = table[table.untrained & (table.variant == "in-batch") & (table.seed == 0)]
    trained = table[~table.untrained]
    print("| negatives | width | " + " | ".join(MEASURES) + " |\n" + "|---" * 7 + "|")
    for name, rows in [("untrained", untrained), *trained.groupby("variant", sort=False)]:
        for width, same in rows.groupby("width", sort=False):
            cells = [summarize(same[measure], measure) for measure in MEASURES]
            print(f"| {name} | {width} | " + " | ".join(cells) + " |", flush=True)


def summarize(values: pd.Series, measure: str) -> str:
    """The mean, with the least and the greatest of several."""
    digits = MEASURES[measure]
    scaled = 100 * values if measure.startswith("recall") else values
    mean = f"{scaled.mean():.{digits}f}"
    if len(scaled) == 1:
        return mean
    return f"{mean} [{scaled.min():.{digits}f}, {scaled.max():.{digits}f}]"


if __name__ == "__main__":
    main()
