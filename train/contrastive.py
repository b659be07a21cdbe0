"""Train a retriever: a Matryoshka loss over cached multiple-negatives ranking."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics
from conf.schema import ContrastiveCommand
from conf.trackers import check_trackers

log = logging.getLogger(__name__)


@command("train.contrastive", ContrastiveCommand)
def main(cfg: ContrastiveCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished: delete it, or set run=NAME, to train again", run.folder)
        return metrics

    restrict_to_one_gpu()
    check_trackers(cfg.train.report_to)

    from data.build import ensure_benchmark
    from models import distributed

    distributed.check_unsharded()
    rank_batch = distributed.per_rank_batch(cfg.train.batch)
    store = distributed.from_main(
        lambda: ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    )

    from train.retriever.run import train_retriever

    return train_retriever(cfg, run, store, rank_batch)


if __name__ == "__main__":
    main()
