"""Train a student on rationales or answers, with LoRA over a frozen base."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.gpus import restrict_to_one_gpu
from dynapix.conf.runs import rank, read_finished_metrics
from dynapix.conf.schema import SftCommand

log = logging.getLogger(__name__)


@command("train.sft", SftCommand, ranks=True)
def main(cfg: SftCommand, run: Run) -> dict[str, float]:
    if (metrics := read_finished_metrics(run)) is not None:
        return metrics
    restrict_to_one_gpu()

    from transformers import set_seed

    from dynapix.data.build import ensure_benchmark
    from dynapix.models import compat, distributed, loading
    from dynapix.models.checks import check_available
    from dynapix.models.layers.fast_layers import use_fast_layers
    from dynapix.models.resolved_settings import data_digest, resolve_run
    from dynapix.teacher.narrate import ensure_rationales
    from dynapix.train.common import training_loop
    from dynapix.train.common.journal import run_metrics
    from dynapix.train.common.model_card import write_run_card
    from dynapix.train.student.dataset import load_datasets, tokenizer_corpus
    from dynapix.train.student.trainer import build_trainer

    training_loop.check_trackers(cfg.train.report_to)
    compat.keep_freed_memory()
    # Check the batch and the base now, because building the benchmark may take long.
    distributed.split_batch(cfg.train.batch, cfg.train.micro_batch)
    if cfg.student.model is not None:
        check_available("student", cfg.student.model)

    # The main rank builds and narrates what is missing; then every rank reads it from the disk.
    with distributed.main_first():
        checkpoint = training_loop.newest_checkpoint(run.folder)
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
        rationales = (
            [] if cfg.train.regime == "answer_only" else ensure_rationales(store, cfg.teacher)
        )
    training, validation = load_datasets(cfg, store, rationales)

    data = data_digest(store.identity, training.texts)
    with distributed.main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, cfg.student, data)
    cfg = replace(cfg, student=student, train=replace(cfg.train, precision=precision))

    log.info("loading student %s, computing in %s", student.name, precision)
    # Seed the initialisation of the adapters; the trainer sets its seed later.
    set_seed(cfg.seed)
    corpus = partial(tokenizer_corpus, store, rationales)
    with training_loop.explain_load_errors("student"):
        model, processor = loading.load_student(student, precision, corpus)
        if not distributed.is_sharded():
            model.to(distributed.rank_device())
    use_fast_layers(model)

    trainer = build_trainer(cfg, run, model, processor, training, validation, checkpoint)
    remedy = "lower train.micro_batch, set train.reuse_features=false"
    last_resort = "student.image_size or student.frames"
    training_loop.run_training(trainer, run, checkpoint, remedy, last_resort)

    weights = training_loop.gather_weights(trainer)
    metrics = run_metrics(run.folder)
    if rank() == 0:
        loading.save_student(model, processor, run.folder / "student", precision, weights)
        write_run_card(run, cfg, metrics)
    log.info("the student is in %s", run.folder / "student")
    return metrics


if __name__ == "__main__":
    main()
