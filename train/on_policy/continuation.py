"""Functions that train.distill and train.reinforce share: both train the student of another run
further."""

from __future__ import annotations

import logging
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TypeVar

import yaml
from torch import nn
from transformers import ProcessorMixin, Trainer

from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.conf.runs import Run, rank
from dynapix.conf.schema import DistillCommand, ReinforceCommand, SftCommand
from dynapix.models import loading
from dynapix.models.distributed import is_sharded, main_first, rank_device
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.models.resolved_settings import check_base, resolve_run
from dynapix.models.trained_runs import (
    STUDENT_SETTINGS,
    check_sees_frames,
    product_folder,
    read_trained_settings,
)
from dynapix.train.common.journal import run_metrics
from dynapix.train.common.model_card import write_run_card
from dynapix.train.common.training_loop import run_training

log = logging.getLogger(__name__)

Command = TypeVar("Command", DistillCommand, ReinforceCommand)


def read_source_settings(model: str | None) -> tuple[Path, SftCommand]:
    """Return the folder and the settings of the run whose student is trained further.

    Raises:
        UserError: The run is missing or cannot be read, its student does not write rationales about
            frames, its base has changed, or the launcher shards the model.
    """
    if is_sharded():
        raise UserError(
            "a student that is trained on its own responses cannot be sharded with FSDP, since it "
            "generates texts between its steps: start without --use_fsdp",
            code="unsupported-with-fsdp",
        )
    if model is None:
        raise UserError(
            "model is missing: give the folder of a run of train.sft, such as "
            "model=checkpoints/sft/exp-cot",
            code="missing-run",
        )
    source = Path(model)
    trained = read_trained_settings(source, SftCommand, "student")
    check_sees_frames(source, trained.train.facts)
    if trained.train.regime == "answer_only":
        raise UserError(
            f"model={source} was trained with train.regime=answer_only and writes no rationales: "
            "give a run of another regime, such as one of train.sft +exp=cot",
            code="untrained-mode",
        )
    check_base(source, trained.student)
    return source, trained


def inherit_settings(cfg: Command, trained: SftCommand) -> Command:
    """Return a run's settings in which those of the student's training replace null. The
    learning rate is the share `LR_SHARE` of that of the student's training."""
    inherited = {
        "lr": cfg.train.LR_SHARE * trained.train.lr,
        "micro_batch": trained.train.micro_batch,
        "gradient_checkpointing": trained.train.gradient_checkpointing,
        "permute_candidates": trained.train.permute_candidates,
    }
    missing = {f.name for f in fields(cfg.train) if getattr(cfg.train, f.name) is None}
    changes = {name: value for name, value in inherited.items() if name in missing}
    return replace(cfg, train=replace(cfg.train, **changes))


def resolve_continuation(
    cfg: Command, run: Run, trained: SftCommand, data: str
) -> tuple[Command, SftCommand]:
    """Resolve the precision and the base of a run, and write the settings of its student: those of
    the other run, with the training settings of this run where both have them.

    Args:
        trained: Settings of the run whose student is trained further.
        data: What `data_digest` returns for the run.

    Returns:
        The settings of the run with its precision, and those of its student.
    """
    with main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, trained.student, data)
        cfg = replace(cfg, train=replace(cfg.train, precision=precision))
        names = {f.name for f in fields(trained.train)} & {f.name for f in fields(cfg.train)}
        train = replace(trained.train, **{name: getattr(cfg.train, name) for name in names})
        trained = replace(trained, student=student, train=train, seed=cfg.seed)
        if rank() == 0:
            text = yaml.safe_dump(asdict(trained), sort_keys=False)
            write_text(run.folder / STUDENT_SETTINGS, text)
    return cfg, trained


def load_source(
    source: Path, trained: SftCommand, precision: str
) -> tuple[nn.Module, ProcessorMixin]:
    """Load the student of a run to train it further, on this rank's device."""
    log.info("loading the student of %s, computing in %s", source, precision)
    weights = product_folder(source, "student")
    model, processor = loading.load_trainable(trained.student, precision, weights)
    model.to(rank_device())
    use_fast_layers(model)
    return model, processor


def train_and_save(
    trainer: Trainer,
    processor: ProcessorMixin,
    run: Run,
    checkpoint: Path | None,
    trained: SftCommand,
    last_resort: str,
) -> dict[str, float]:
    """Train a student, save it in the run's folder, and return the run's metrics.

    Args:
        trainer: A trainer with a `response_sampler`.
        trained: The settings of the student, from `resolve_continuation`.
        last_resort: Settings to lower if memory still runs out; they change the result.
    """
    remedy = "lower train.micro_batch or train.sampling_batch,"
    run_training(trainer, run, checkpoint, remedy, last_resort)
    metrics, folder = run_metrics(run.folder), run.folder / "student"
    if rank() == 0:
        loading.save_student(trainer.model, processor, folder, trained.train.precision)
        write_run_card(run, trained, metrics)
    trainer.response_sampler.close()
    log.info("the student is in %s", folder)
    return metrics
