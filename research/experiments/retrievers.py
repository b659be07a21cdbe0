"""Compares ways to train the tiny retriever: over the tiny base (also with in-batch negatives only,
and with late interaction) and from random weights; three seeds each.

    python -m research.experiments.retrievers            # train and evaluate what is missing
    python -m research.experiments.retrievers --table    # print the recorded results

`--benchmark tiny_balanced` compares them on balanced items. Results are recorded in
`ranks.parquet`, one row per run, width and builder. The tables have means over the seeds, each with
the smallest and the largest value: all queries at every width, and Recall@10 at full width by
builder.
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import ContrastiveCommand
from dynapix.data.versions import BUILDERS
from dynapix.evaluation.metrics.results import RetrievalResult, from_json
from dynapix.models.fingerprints import weights_digest
from research.experiments.experiment import (
    Experiment,
    Job,
    create_parser,
    print_header,
    print_row,
    training_key,
)

RANKS = Path(__file__).with_name("ranks.parquet")
VARIANTS: dict[str, list[str]] = {
    "over the base": [],
    "over the base, in-batch negatives": ["train.hard_negatives=0"],
    "over the base, late interaction": ["+exp=late_interaction"],
    "from random weights": ["retriever=tiny_scratch"],
}
"""Overrides of `train.contrastive`, which by default uses one hard negative per query."""
UNTRAINED = "untrained base"
MEASURES = {"recall@1": 1, "recall@10": 1, "recall@50": 1, "mrr": 3, "median_rank": 1}
"""The printed measures and their decimals; recalls are in percent."""


def main() -> None:
    parser = create_parser(__doc__, "tiny", RANKS)
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS], default=[*VARIANTS])
    args = parser.parse_args()
    benchmark = f"benchmark={args.benchmark}"
    base = compose("train.contrastive", ContrastiveCommand, [benchmark]).retriever.model
    # Results of other settings, another base or other items are not reused.
    versions = {"builders": BUILDERS}
    settings = {
        name: training_key("train.contrastive", ContrastiveCommand, [*variant, benchmark], versions)
        for name, variant in VARIANTS.items()
    }
    experiment = Experiment(args, weights_digest(base), settings)

    def evaluate(job: Job) -> list[dict[str, Any]]:
        variant, seed = job
        name = experiment.run_name(*job)
        training = [*VARIANTS[variant], f"seed={seed}", *experiment.shared_overrides]
        trained = experiment.train("train.contrastive", name, training)
        return read_ranks(experiment.evaluate("evaluation.retrieve", name, [f"model={trained}"]))

    jobs = [(variant, seed) for seed, variant in product(range(args.seeds), args.variants)]
    print_tables(experiment.run(jobs, evaluate))


def read_ranks(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a run: its results at each width, by builder and over all queries."""
    report = json.loads((folder / "report.json").read_text())
    results = from_json(list[RetrievalResult], report["rows"])
    return [
        {
            "untrained": result.untrained, "width": result.width, "builder": result.builder,
            **{name: result.measures[name].value for name in MEASURES},
            "queries": result.queries, "frames": result.frames, "bytes": result.bytes,
            "seconds": result.seconds,
        }
        for result in results
    ]  # fmt: skip


def print_tables(table: pd.DataFrame) -> None:
    # Every run also measures its model before the training, which is the same for all seeds.
    first = next(iter(VARIANTS))
    untrained = table[table.untrained & (table.variant == first) & (table.seed == 0)]
    groups = [(UNTRAINED, untrained), *table[~table.untrained].groupby("variant", sort=False)]
    print_header("retriever", "width", *MEASURES)
    for name, rows in groups:
        for width, same in rows[rows.builder.isna()].groupby("width", sort=False):
            print_row(name, width, *(summarize(same[m], m) for m in MEASURES))
    print_header("Recall@10 by builder", *sorted(table.builder.dropna().astype(int).unique()))
    for name, rows in groups:
        widest = rows[(rows.width == rows.width.max()) & rows.builder.notna()]
        by_builder = widest.groupby("builder")["recall@10"]
        print_row(name, *(summarize(values, "recall@10") for _, values in by_builder))


def summarize(values: pd.Series, measure: str) -> str:
    """Format the mean, followed by the smallest and the largest value if there are several."""
    digits = MEASURES[measure]
    scaled = 100 * values if measure.startswith("recall") else values
    mean = f"{scaled.mean():.{digits}f}"
    if len(scaled) == 1:
        return mean
    return f"{mean} [{scaled.min():.{digits}f}, {scaled.max():.{digits}f}]"


if __name__ == "__main__":
    with report_failures():
        main()
