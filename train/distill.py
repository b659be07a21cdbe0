"""Train a student further on its own responses, towards a teacher that reads the facts."""

from __future__ import annotations

import logging
from dataclasses import asdict, fields, replace
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.gpus import restrict_to_one_gpu
from conf.runs import finished_metrics, rank
from conf.schema import DistillCommand, SftCommand, StudentTrainConfig
from conf.trackers import check_trackers

log = logging.getLogger(__name__)


@command("train.distill", DistillCommand)
def main(cfg: DistillCommand, run: Run) -> dict[str, float]:
    if cfg.model is None:
        raise UserError(
            "model is missing: give the folder of a run of train.sft, such as "
            "model=checkpoints/sft/exp-cot",
            code="missing-run",
        )
    if (metrics := finished_metrics(run)) is not None:
        log.info("%s is finished; to train again, delete it or give run=NAME", run.folder)
        return metrics
    restrict_to_one_gpu()
    check_trackers(cfg.train.report_to)

    import yaml

    from conf.files import write_text
    from data.build import ensure_benchmark
    from models import compat, distributed, loading
    from models.fingerprints import weights_digest
    from models.lora_kernels import use_fast_layers
    from models.resolved import check_base, data_digest, resolve_run
    from models.trained_runs import STUDENT_SETTINGS, product_folder
    from teacher.narrate import ensure_rationales
    from train.common import training_loop
    from train.common.checkpoints import newest_checkpoint
    from train.common.journal import run_metrics
    from train.student.distillation import build_trainer, load_teacher
    from train.student.paired_prompts import load_datasets

    compat.keep_freed_memory()
    distributed.split_batch(cfg.train.batch, cfg.train.micro_batch)
    if distributed.is_sharded():
        raise UserError(
            "train.distill does not work with FSDP, since the student generates texts between its "
            "steps: start without --use_fsdp",
            code="unsupported-with-fsdp",
        )
    source = Path(cfg.model)
    trained = source_settings(source)
    check_base(source, trained.student)
    weights = product_folder(source, "student")

    # The main rank builds and narrates what is missing; then every rank reads it from the disk.
    with distributed.main_first():
        checkpoint = newest_checkpoint(run.folder)
        store = ensure_benchmark(trained.benchmark, Path(cfg.store), cfg.workers)
        rationales = ensure_rationales(store, trained.teacher)
    training, validation = load_datasets(cfg, trained, store, rationales)

    models = weights_digest(weights, product_folder(Path(cfg.teacher_model or source), "student"))
    data = data_digest(store.identity, [*training.texts, models])
    with distributed.main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, trained.student, data)
        cfg = replace(cfg, train=replace(cfg.train, precision=precision))
        trained = replace(trained, student=student, train=merge_settings(trained, cfg))
        if rank() == 0:
            settings = yaml.safe_dump(asdict(replace(trained, seed=cfg.seed)), sort_keys=False)
            write_text(run.folder / STUDENT_SETTINGS, settings)

    log.info("loading the student of %s, computing in %s", source, precision)
    model, processor = loading.load_trainable(student, precision, weights)
    model.to(distributed.rank_device())
    teacher = load_teacher(cfg, trained, processor)
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


def source_settings(source: Path) -> SftCommand:
    """Return the settings of the run whose student is trained further.

    Raises:
        UserError: The run cannot be read, or its student does not write rationales about frames.
    """
    from models.trained_runs import check_sees_frames, trained_settings

    trained = trained_settings(source, SftCommand, "student")
    check_sees_frames(source, trained.train.facts)
    if trained.train.regime == "answer_only":
        raise UserError(
            f"model={source} was trained with train.regime=answer_only and writes no rationales: "
            "give a run of another regime, such as one of train.sft +exp=cot",
            code="untrained-mode",
        )
    return trained


def merge_settings(trained: SftCommand, cfg: DistillCommand) -> StudentTrainConfig:
    """Return the student's settings of training, with those of the distillation where both have a
    setting."""
    shared = {f.name: getattr(cfg.train, f.name) for f in fields(StudentTrainConfig)}
    return replace(trained.train, **shared)


if __name__ == "__main__":
    main()
