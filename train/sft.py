"""Train a student on rationales or answers: LoRA over a frozen, quantised base."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from conf.entry import Run, command
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics, rank
from conf.schema import SftCommand
from conf.trackers import check_trackers

log = logging.getLogger(__name__)


@command("train.sft", SftCommand)
def main(cfg: SftCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; to train again, delete it or give run=NAME", run.folder)
        return metrics
    check_trackers(cfg.train.report_to)
    restrict_to_one_gpu()

    from transformers import set_seed

    from data.build import ensure_benchmark
    from models import loading
    from models.compat import keep_freed_memory
    from models.distributed import accumulation_steps, is_sharded, main_first, rank_device
    from models.lora_kernels import fuse
    from models.resolved import data_digest, resolve_run
    from teacher.narrate import ensure_rationales
    from train.common.checkpoints import newest_checkpoint
    from train.common.journal import run_metrics
    from train.common.training_loop import (
        explain_load_errors,
        gather_weights,
        lower_memory,
        run_training,
    )
    from train.student.dataset import WITHOUT_RATIONALES, tokenizer_corpus
    from train.student.run import build_trainer, load_datasets

    keep_freed_memory()
    accumulation = accumulation_steps(cfg.train.batch, cfg.train.micro_batch)
    checkpoint = newest_checkpoint(run.folder)

    # The main rank builds and narrates what is missing; then every rank reads it from the disk.
    with main_first():
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
        without = cfg.train.regime in WITHOUT_RATIONALES
        rationales = [] if without else ensure_rationales(store, cfg.teacher)
    training, validation = load_datasets(cfg, store, rationales)

    data = data_digest(store.identity, training.texts)
    with main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, cfg.student, data)
    cfg = replace(cfg, student=student, train=replace(cfg.train, precision=precision))

    log.info("loading student %s, to compute in %s", student.name, precision)
    # Adapters are initialised before the trainer sets its seed.
    set_seed(cfg.seed)
    with explain_load_errors(run.folder, "student"):
        model, processor = loading.load_student(
            student, precision, partial(tokenizer_corpus, store, rationales)
        )
        if not is_sharded():
            model.to(rank_device())
    fuse(model)

    trainer = build_trainer(
        cfg, run, model, processor, training, validation, accumulation, checkpoint
    )
    advice = lower_memory(cfg.train, "micro_batch", "student.image_size or student.frames")
    best_step = run_training(trainer, run, checkpoint, advice)

    weights = gather_weights(trainer)
    if rank() == 0:
        # A base is written in bf16, as bases are released, whatever precision it was trained in.
        written = "bf16" if cfg.train.regime == "describe" else precision
        loading.save_student(model, processor, run.folder / "student", written, weights)
    log.info("the student is in %s", run.folder / "student")
    return run_metrics(run.folder, best_step)


if __name__ == "__main__":
    main()
