"""Train a student on rationales or answers: LoRA over a frozen, quantised base."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics
from conf.schema import SftCommand
from conf.trackers import check_trackers

if TYPE_CHECKING:
    from data.records import Rationale
    from data.store import Store

log = logging.getLogger(__name__)


@command("train.sft", SftCommand)
def main(cfg: SftCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; delete it, or give run=NAME, to train anew", run.folder)
        return metrics

    restrict_to_one_gpu()
    check_trackers(cfg.train.report_to)

    from models import distributed

    smallest = 1 if cfg.train.micro_batch == "auto" else cfg.train.micro_batch
    distributed.accumulation_steps(cfg.train.batch, smallest)
    store, rationales = distributed.from_main(partial(prepared, cfg))

    from train.student.run import train_student

    return train_student(cfg, run, store, rationales)


def prepared(cfg: SftCommand) -> tuple[Store, list[Rationale]]:
    """The benchmark, and the rationales where the regime has any, made where they are missing."""
    from data.build import ensure_benchmark
    from teacher.narrate import ensure_rationales

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    told = cfg.train.regime != "answer_only"
    return store, ensure_rationales(store, cfg.teacher) if told else []


if __name__ == "__main__":
    main()
