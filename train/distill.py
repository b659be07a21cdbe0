"""Train a student further on its own responses, towards a teacher that reads the facts."""

from __future__ import annotations

from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.gpus import restrict_to_one_gpu
from dynapix.conf.runs import read_finished_metrics
from dynapix.conf.schema import DistillCommand


@command("train.distill", DistillCommand, ranks=True)
def main(cfg: DistillCommand, run: Run) -> dict[str, float]:
    if (metrics := read_finished_metrics(run)) is not None:
        return metrics
    restrict_to_one_gpu()

    from dynapix.data.build import ensure_benchmark
    from dynapix.models import compat, distributed
    from dynapix.models.fingerprints import weights_digest
    from dynapix.models.resolved_settings import data_digest
    from dynapix.models.trained_runs import product_folder
    from dynapix.teacher.narrate import ensure_rationales
    from dynapix.train.common.training_loop import check_trackers, newest_checkpoint
    from dynapix.train.on_policy.continuation import (
        inherit_settings,
        load_source,
        read_source_settings,
        resolve_continuation,
        train_and_save,
    )
    from dynapix.train.on_policy.distillation import build_trainer
    from dynapix.train.on_policy.paired_prompts import load_datasets
    from dynapix.train.on_policy.teachers import (
        LocalTeacher,
        ServerTeacher,
        load_teacher,
        read_teacher_settings,
    )

    check_trackers(cfg.train.report_to)
    compat.keep_freed_memory()
    source, trained = read_source_settings(cfg.model)
    cfg = inherit_settings(cfg, trained)
    distributed.split_batch(cfg.train.batch, cfg.train.micro_batch)
    teacher_run = None if cfg.teacher_server.url else read_teacher_settings(cfg, trained)

    # The main rank builds and narrates what is missing; then every rank reads it from the disk.
    with distributed.main_first():
        checkpoint = newest_checkpoint(run.folder)
        store = ensure_benchmark(trained.benchmark, Path(cfg.store), cfg.workers)
        rationales = ensure_rationales(store, trained.teacher)
    training, validation = load_datasets(cfg, trained, store, rationales)
    folders = [source] if teacher_run is None else [source, teacher_run[0]]
    weights = weights_digest(*(product_folder(folder, "student") for folder in folders))
    data = data_digest(store.identity, [*training.texts, weights])
    cfg, trained = resolve_continuation(cfg, run, trained, data)

    precision = cfg.train.precision
    model, processor = load_source(source, trained, precision)
    if teacher_run is None:
        teacher = ServerTeacher(cfg.teacher_server, processor)
    else:
        teacher_model = load_teacher(*teacher_run, precision, processor)
        teacher = LocalTeacher(teacher_model, processor, precision == "bf16")
    trainer = build_trainer(
        cfg, trained, run, model, teacher, processor, training, validation, checkpoint
    )
    return train_and_save(trainer, processor, run, checkpoint, trained, "train.batch")


if __name__ == "__main__":
    main()
