"""Compares ways to train the tiny retriever on the small benchmark: with in-batch negatives only,
with same-scene hard negatives, and with late interaction; three seeds each, at every width.

    python -m benchmarks.experiments.retrievers            # train and evaluate what is missing
    python -m benchmarks.experiments.retrievers --table    # print the recorded results

Results are recorded in `ranks.parquet`, one row per run and width. The table has means over the
seeds, each with the smallest and the largest value. It also has variants whose settings no longer
exist: `hard-scenes` (batches composed scene by scene), `masked` (the same, with near-identical
frames masked) and `mined` (negatives mined during training).
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.experiments.experiment import Experiment, Job, create_parser
from evaluation.metrics.results import RetrievalResult, from_json

RANKS = Path(__file__).with_name("ranks.parquet")
VARIANTS: dict[str, list[str]] = {
    "in-batch": ["train.hard_negatives=0"],
    "hard": [],
    "late": ["+exp=late_interaction"],
}
"""Overrides of `train.contrastive`, which by default uses one hard negative per query."""
MEASURES = {"recall@1": 1, "recall@10": 1, "recall@50": 1, "mrr": 3, "median_rank": 1}
"""The printed measures and their decimals; recalls are in percent."""


def main() -> None:
    args = create_parser(__doc__, "small", RANKS).parse_args()
    identity = {"benchmark": args.benchmark}
    experiment = Experiment(args, identity, "variant", "train.contrastive", "evaluation.retrieve")

    def evaluate(job: Job) -> list[dict[str, Any]]:
        variant, seed = job
        name, training = f"{args.benchmark}-{variant}-{seed}", [*VARIANTS[variant], f"seed={seed}"]
        return read_ranks(experiment.train_and_evaluate(name, training))

    jobs = [(variant, seed) for seed, variant in product(range(args.seeds), VARIANTS)]
    print_table(experiment.run(jobs, evaluate))


def read_ranks(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a run: its results at each width over the queries of all builders."""
    report = json.loads((folder / "report.json").read_text())
    results = from_json(list[RetrievalResult], report["rows"])
    return [
        {
            "untrained": result.untrained, "width": result.width,
            **{name: result.measures[name].value for name in MEASURES},
            "queries": result.queries, "frames": result.frames, "bytes": result.bytes,
            "seconds": result.seconds,
        }
        for result in results
        if result.builder is None
    ]  # fmt: skip


def print_table(table: pd.DataFrame) -> None:
    # Every run also measures the untrained retriever. It is the same in all of them: print it once.
    untrained = table[table.untrained & (table.variant == "in-batch") & (table.seed == 0)]
    trained = table[~table.untrained]
    print("| negatives | width | " + " | ".join(MEASURES) + " |\n" + "|---" * 7 + "|")
    for name, rows in [("untrained", untrained), *trained.groupby("variant", sort=False)]:
        for width, same in rows.groupby("width", sort=False):
            cells = [summarize(same[measure], measure) for measure in MEASURES]
            print(f"| {name} | {width} | " + " | ".join(cells) + " |", flush=True)


def summarize(values: pd.Series, measure: str) -> str:
    """Format the mean, followed by the smallest and the largest value if there are several."""
    digits = MEASURES[measure]
    scaled = 100 * values if measure.startswith("recall") else values
    mean = f"{scaled.mean():.{digits}f}"
    if len(scaled) == 1:
        return mean
    return f"{mean} [{scaled.min():.{digits}f}, {scaled.max():.{digits}f}]"


if __name__ == "__main__":
    main()
