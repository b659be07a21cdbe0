"""Train a retriever: Matryoshka over cached multiple-negatives ranking."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics
from conf.schema import ContrastiveCommand
from conf.trackers import check_trackers

if TYPE_CHECKING:
    from data.store import Store

log = logging.getLogger(__name__)


@command("train.contrastive", ContrastiveCommand)
def main(cfg: ContrastiveCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; delete it, or give run=NAME, to train anew", run.folder)
        return metrics

    restrict_to_one_gpu()
    check_trackers(cfg.train.report_to)

    from models import distributed

    distributed.check_unsharded()
    share = distributed.per_rank_batch(cfg.train.batch)
    store = distributed.from_main(partial(prepared, cfg))

    from train.retriever.run import train_retriever

    return train_retriever(cfg, run, store, share)


def prepared(cfg: ContrastiveCommand) -> Store:
    """The benchmark, made where it is missing."""
    from data.build import ensure_benchmark

    return ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)


if __name__ == "__main__":
    main()
