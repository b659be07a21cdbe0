"""Run a trainer from its start or a checkpoint to its end, and turn library errors into advice."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import torch
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from tqdm.contrib.logging import logging_redirect_tqdm
from transformers import PrinterCallback, ProgressCallback, Trainer
from transformers.trainer_callback import TrainerState

from conf.errors import UserError
from conf.runs import Run, rank, run_id
from models.distributed import is_sharded
from models.memory import explain_out_of_memory
from train.common.arguments import PROJECT
from train.common.callbacks import BestCheckpointCallback, JournalCallback, MetricsBar
from train.common.checkpoints import STATE, check_best_checkpoint

log = logging.getLogger(__name__)

SERIALIZED = f"{UserError.__module__}.{UserError.__qualname__}: "
"""What precedes the message of a UserError in the traceback of another process."""


def run_training(
    trainer: Trainer, run: Run, checkpoint: Path | None, memory_settings: str
) -> int | None:
    """Train from the start or a checkpoint, and keep the journal and the curves.

    Args:
        memory_settings: The settings to lower when memory runs out.

    Returns:
        The step of the best checkpoint, whose weights the trainer's model then has, if
        train.best_metric names a measure; else None.

    Raises:
        UserError: memory runs out, no evaluation has the measure of train.best_metric, or a worker
            process or another rank raises a UserError.
    """
    add_callbacks(trainer, run)
    check_fsdp(trainer, checkpoint)
    advice = (
        f"lower {memory_settings}, or set train.gradient_checkpointing=true and "
        "train.reuse_features=false, in another run (run=NAME)"
    )
    with explain_errors("while training", advice):
        train_to_last_step(trainer, checkpoint)
    best_step = trainer.state.best_global_step
    if best_step:
        measure = f"{trainer.args.metric_for_best_model} = {trainer.state.best_metric:.4g}"
        log.info("keeping the checkpoint of step %d, the best by %s", best_step, measure)
    return best_step


def add_callbacks(trainer: Trainer, run: Run) -> None:
    """Add the progress bar, the journal, the checks, and the trackers' settings."""
    trainer.remove_callback(ProgressCallback)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(MetricsBar())
    if rank() == 0:
        trainer.add_callback(JournalCallback(run.folder))
    trainer.add_callback(BestCheckpointCallback())
    if "wandb" in trainer.args.report_to:
        # A resumed run is the same run at W&B; its files belong into the run's folder.
        wandb = {"DIR": run.folder, "PROJECT": PROJECT, "RUN_ID": run_id(run), "RESUME": "allow"}
        for name, value in wandb.items():
            os.environ.setdefault(f"WANDB_{name}", str(value))


def train_to_last_step(trainer: Trainer, checkpoint: Path | None) -> None:
    """Train from the start or a checkpoint; after the last step, only load the final weights."""
    if checkpoint is not None:
        log.info("resuming from %s", checkpoint)
        state = TrainerState.load_from_json(str(checkpoint / STATE))
        check_best_checkpoint(checkpoint, state.best_global_step)
        if state.global_step >= state.max_steps:
            # The trainer would train for one more step.
            trainer.state = state
            best = state.best_global_step or state.global_step
            load_weights(trainer, checkpoint.with_name(f"checkpoint-{best}"))
            return
    # Log lines are printed above the progress bar.
    with logging_redirect_tqdm():
        trainer.train(resume_from_checkpoint=str(checkpoint) if checkpoint else None)


@contextmanager
def explain_errors(when: str, lower: str) -> Iterator[None]:
    """Turn library errors that the user can correct into a UserError.

    Args:
        when: What the program is doing.
        lower: The settings to lower when memory runs out.
    """
    try:
        with explain_out_of_memory(when, lower):
            yield
    except RuntimeError as error:
        if SERIALIZED not in str(error):
            raise
        # The error of another rank, whose traceback the library includes.
        raise UserError(user_message(error), code="failed-rank") from error
    except UserError as error:
        raise UserError(user_message(error), code=error.code) from error


def explain_load_errors(group: str) -> AbstractContextManager[None]:
    """Apply `explain_errors` while a student or retriever is loaded."""
    advice = f"set {group}.quantization=nf4, or give a smaller {group}.model"
    return explain_errors(f"while loading the {group}", advice)


def user_message(error: Exception) -> str:
    """Return an error's message without the traceback of a worker process or of another rank."""
    return str(error).rpartition(SERIALIZED)[2].strip()


def check_fsdp(trainer: Trainer, checkpoint: Path | None) -> None:
    """Raise UserError if the launcher's FSDP cannot train here, or if a run that was started with
    FSDP is resumed without it, or the reverse."""
    fsdp = trainer.is_fsdp_enabled
    if is_sharded() and not fsdp:
        raise UserError(
            "accelerate has FSDP for several GPUs only and would train without it: start without "
            "--use_fsdp (and with --multi_gpu, on CPUs too)",
            code="unsupported-with-fsdp",
        )
    if fsdp and trainer.accelerator.state.fsdp_plugin.fsdp_version != 2:
        raise UserError(
            "only version 2 of FSDP trains adapters: give --fsdp_version 2",
            code="unsupported-with-fsdp",
        )
    if checkpoint is not None and any(checkpoint.glob("pytorch_model_fsdp*")) != fsdp:
        started = "without" if fsdp else "with"
        raise UserError(
            f"{checkpoint} was written {started} FSDP: start the run {started} it again, on any "
            "number of ranks, or start another one with run=NAME",
            code="other-launch",
        )


def load_weights(trainer: Trainer, checkpoint: Path) -> None:
    """Load a checkpoint's weights without resuming from it."""
    if trainer.is_fsdp_enabled:
        # A sharded checkpoint needs a sharded model, and accelerate shards it with its optimizer.
        trainer.create_optimizer()
        trainer.accelerator.prepare(trainer.model, trainer.optimizer)
    trainer._load_from_checkpoint(str(checkpoint))


def gather_weights(trainer: Trainer) -> dict[str, torch.Tensor] | None:
    """Return the trained weights on the main rank if the model is sharded, else None."""
    if not trainer.is_fsdp_enabled:
        return None
    options = StateDictOptions(full_state_dict=True, cpu_offload=True, ignore_frozen_params=True)
    return get_model_state_dict(trainer.model, options=options)
