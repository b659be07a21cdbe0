"""Train the tiny base, a small Qwen3-VL, from random weights on what the oracle knows.

`make base` runs this and replaces the committed base.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.runs import rank, read_finished_metrics
from research.tiny_base.settings import TinyBaseCommand

log = logging.getLogger(__name__)


@command("research.base", TinyBaseCommand, ranks=True)
def main(cfg: TinyBaseCommand, run: Run) -> dict[str, float]:
    if (metrics := read_finished_metrics(run)) is not None:
        return metrics

    from transformers import set_seed

    from dynapix.data.build import ensure_benchmark
    from dynapix.data.frames.frame_cache import FrameReader
    from dynapix.models import compat, loading
    from dynapix.models.distributed import end_ranks, main_first, split_batch
    from dynapix.models.resolved_settings import resolve_precision
    from dynapix.train.common.held_out import shuffled
    from research.tiny_base.measures import measure_generated_answers
    from research.tiny_base.samples import ItemSampler, split_items, tokenizer_corpus
    from research.tiny_base.training import STAGES, build_trainer

    for stage in STAGES:
        split_batch(getattr(cfg.train, stage).batch, key=f"train.{stage}.batch")
    compat.keep_freed_memory()
    with main_first():
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    frames = FrameReader(store, cfg.student.image_size)
    training, held_out = split_items(store, frames)
    sampler = ItemSampler(training, frames, cfg.student.frames, cfg.seed)
    precision = resolve_precision(cfg.train.precision, on_cpu=True)
    cfg = replace(cfg, train=replace(cfg.train, precision=precision))

    log.info("training %s on %d items, computing in %s", cfg.student.name, len(training), precision)
    set_seed(cfg.seed)
    corpus = partial(tokenizer_corpus, sampler)
    model, processor = loading.load_base(cfg.student, precision, corpus)
    measured = shuffled(held_out, cfg.seed)[: cfg.train.validation_items]
    trainer = build_trainer(cfg, run, model, processor, sampler, measured)
    trainer.run()
    end_ranks()
    if rank() > 0:
        return {}
    log.info("measuring the base on %d items of held-out scenes", len(measured))
    metrics = trainer.probe.measure("words")
    metrics |= measure_generated_answers(
        model, processor, sampler, measured, cfg.student, precision
    )
    # A base is saved in bf16, as released bases are, whatever its precision in training.
    loading.save_student(model, processor, run.folder / "student", "bf16")
    log.info("the base is in %s", run.folder / "student")
    return metrics


if __name__ == "__main__":
    main()
