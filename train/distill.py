"""Train a student further on its own texts, which a teacher that reads the facts scores."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from conf.entry import Run, command
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics, rank
from conf.schema import DistillCommand, SftCommand
from conf.trackers import check_trackers

log = logging.getLogger(__name__)


@command("train.distill", DistillCommand)
def main(cfg: DistillCommand, run: Run) -> dict[str, float]:
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; to train again, delete it or give run=NAME", run.folder)
        return metrics
    restrict_to_one_gpu()
    check_trackers(cfg.train.report_to)

    from data.build import ensure_benchmark
    from models import compat, distributed, loading
    from models.lora_kernels import use_fast_layers
    from models.resolved import data_digest, resolve_run
    from models.trained_runs import (
        check_modes,
        check_sees_frames,
        product_folder,
        trained_settings,
    )
    from teacher.narrate import ensure_rationales
    from train.common import training_loop
    from train.common.checkpoints import newest_checkpoint
    from train.common.journal import run_metrics
    from train.student.distillation import build_trainer, load_teacher
    from train.student.paired_prompts import load_datasets

    compat.keep_freed_memory()
    distributed.split_batch(cfg.train.batch, cfg.train.micro_batch)
    source = Path(cfg.model)
    trained = trained_settings(source, SftCommand, "student")
    check_sees_frames(source, trained.train.facts)
    check_modes(source, trained.train.regime, ["reasoning"])

    with distributed.main_first():
        checkpoint = newest_checkpoint(run.folder)
        store = ensure_benchmark(trained.benchmark, Path(cfg.store), cfg.workers)
        rationales = ensure_rationales(store, trained.teacher)
    training, validation = load_datasets(cfg, trained, store, rationales)

    data = data_digest(store.identity, training.texts)
    with distributed.main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, trained.student, data)
    cfg = replace(cfg, train=replace(cfg.train, precision=precision))
    trained = replace(trained, student=student)

    log.info("loading the student of %s, computing in %s", source, precision)
    with training_loop.explain_load_errors("student"):
        weights = product_folder(source, "student")
        model, processor = loading.load_to_continue(student, precision, weights)
        teacher = load_teacher(cfg, trained, processor)
        model.to(distributed.rank_device())
    use_fast_layers(model)

    trainer = build_trainer(
        cfg, trained, run, model, teacher, processor, training, validation, checkpoint
    )
    memory_settings = "train.batch or train.micro_batch"
    best_step = training_loop.run_training(trainer, run, checkpoint, memory_settings)

    if rank() == 0:
        loading.save_student(model, processor, run.folder / "student", precision)
    log.info("the student is in %s", run.folder / "student")
    return run_metrics(run.folder, best_step)


if __name__ == "__main__":
    main()
