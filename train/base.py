"""Train the tiny base, a small Qwen3-VL, from random weights on what the oracle knows.

`make base` runs this and replaces the committed base.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from conf.entry import Run, command
from conf.runs import finished_metrics
from conf.schema import BaseCommand

log = logging.getLogger(__name__)


@command("train.base", BaseCommand)
def main(cfg: BaseCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; to train again, delete it or give run=NAME", run.folder)
        return metrics

    from transformers import set_seed

    from data.build import ensure_benchmark
    from data.render.frame_cache import FrameReader
    from models import compat, loading
    from models.precision import resolve_precision
    from train.tiny_base.data import split_items, tokenizer_corpus
    from train.tiny_base.training import build_trainer

    compat.keep_freed_memory()
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    frames = FrameReader(store, cfg.student.image_size)
    training, held_out = split_items(store, frames)
    precision = resolve_precision(cfg.train.precision)
    cfg = replace(cfg, train=replace(cfg.train, precision=precision))

    log.info("training %s on %d items, computing in %s", cfg.student.name, len(training), precision)
    set_seed(cfg.seed)
    model, processor = loading.load_base(
        cfg.student, precision, lambda: tokenizer_corpus(training, frames, cfg.seed)
    )
    trainer = build_trainer(cfg, run, model, processor, training, held_out, frames)
    trainer.run()
    metrics = trainer.probe.measure("words")
    # A base is saved in bf16, as released bases are, whatever its precision in training.
    loading.save_student(model, processor, run.folder / "student", "bf16")
    log.info("the base is in %s", run.folder / "student")
    return metrics


if __name__ == "__main__":
    main()
