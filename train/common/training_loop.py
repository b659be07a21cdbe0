"""Run a trainer to its last step: its checkpoints, its arguments, and advice for the user instead
of errors of the libraries."""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from tqdm.contrib.logging import logging_redirect_tqdm
from transformers import PrinterCallback, ProgressCallback, Trainer
from transformers.integrations import get_reporting_integration_callbacks
from transformers.trainer_callback import TrainerState

from dynapix.conf.errors import UserError
from dynapix.conf.runs import Run, rank, run_id
from dynapix.conf.schema import TrainConfig
from dynapix.models.compat import checkpointing_arguments
from dynapix.models.distributed import is_sharded
from dynapix.models.memory import explain_out_of_memory
from dynapix.train.common.callbacks import JournalCallback, MetricsBar

log = logging.getLogger(__name__)

PROJECT = "dynapix"
"""Name of the project in experiment trackers."""
SCHEDULES = {"cosine": "cosine", "linear": "linear", "constant": "constant_with_warmup"}
"""The name in transformers of each value of train.schedule."""
USER_ERROR_PREFIX = f"{UserError.__module__}.{UserError.__qualname__}: "
"""The text before the message of a UserError in the traceback of another process."""
MIN_CHECKPOINTS = 2
"""Minimum number of checkpoints of a run, so that a killed run loses at most half of it."""
STATE = "trainer_state.json"
PARTS = {
    "file of weights": (
        "**/*.safetensors",
        "pytorch_model_fsdp*.bin",
        "pytorch_model_fsdp*/.metadata",
    ),
    "optimizer": ("optimizer.*", "optimizer_*/.metadata"),
    "schedule": ("scheduler.pt",),
    "random state": ("rng_state*.pth",),
    "trainer's state": (STATE,),
}
"""The parts of a checkpoint. Each part has patterns of files, at least one of which must match: if,
say, the optimizer or the random state were missing, the trainer would resume without an error, but
not as if it had never stopped. Of the files that FSDP writes, .metadata is written last."""
READERS = {
    ".json": lambda path: json.loads(path.read_bytes()),
    ".safetensors": lambda path: safe_open(path, "pt"),
    # torch writes zip archives, whose table of contents is at the end.
    **dict.fromkeys((".pt", ".pth", ".bin"), lambda path: zipfile.ZipFile(path).close()),
}
"""By suffix, a function that raises an error if a file is incomplete."""
ACCESS_ERRNOS = (errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE)
"""Numbers of operating system errors that say nothing about the content of a file."""


def check_trackers(report_to: Sequence[str]) -> None:
    """Raise UserError if an experiment tracker is unknown or its package is not installed."""
    for name in report_to:
        try:
            for callback in get_reporting_integration_callbacks([name]):
                callback()
        except (ImportError, RuntimeError, ValueError) as error:
            raise UserError(f"train.report_to={name}: {error}", code="unknown-tracker") from error


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint in a run's folder, or None.

    Newer ones that a kill, a crash or a full disk left incomplete are skipped with a warning.
    """
    named = [(re.fullmatch(r"checkpoint-(\d+)", p.name), p) for p in folder.glob("checkpoint-*")]
    numbered = sorted(((int(m[1]), p) for m, p in named if m), reverse=True)
    for k, (_, path) in enumerate(numbered):
        if (problem := find_damage(path)) is None:
            return path
        instead = "trying the one before" if k + 1 < len(numbered) else "training starts again"
        log.warning("%s is incomplete (%s): %s", path, problem, instead)
    return None


def find_damage(checkpoint: Path) -> str | None:
    """Return a phrase that says what is missing or incomplete in a checkpoint, or None.

    The trainer writes its state last, but if the machine crashes, any file may be lost.

    Raises:
        UserError: A file cannot be read. The checkpoint may be complete; without it, the run would
            start again.
    """
    _check_access(checkpoint)
    for part, patterns in PARTS.items():
        if not any(True for pattern in patterns for _ in checkpoint.glob(pattern)):
            return f"its {part} is missing"
    for path in sorted(checkpoint.rglob("*")):
        try:
            if read := READERS.get(path.suffix):
                read(path)
        except (OSError, ValueError, SafetensorError, zipfile.BadZipFile) as error:
            if isinstance(error, OSError) and error.errno in ACCESS_ERRNOS:
                raise _unreadable(path, error) from error
            return f"{path.relative_to(checkpoint)} is incomplete"
    return None


def _check_access(checkpoint: Path) -> None:
    # glob skips a folder that it may not read, and safetensors hides why it cannot open a file.
    for path in (checkpoint, *sorted(checkpoint.rglob("*"))):
        try:
            if path.is_dir():
                os.listdir(path)
            else:
                open(path, "rb").close()
        except OSError as error:
            raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> UserError:
    return UserError(
        f"{path} cannot be read ({error}): correct this and run the same command again",
        code="unreadable-checkpoint",
    )


def common_arguments(
    train: TrainConfig, run: Run, seed: int, checkpoint: Path | None
) -> dict[str, Any]:
    """Return the `TrainingArguments` that students and retrievers have in common.

    Args:
        train: The settings; `precision` is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.
    """
    if checkpoint is None:
        checkpoints = max(train.evaluations, MIN_CHECKPOINTS)
        # The trainer reads a value below 1 as a share of all steps, but 1 as every step.
        steps = {
            "eval_steps": min(1 / train.evaluations, 1 - 1e-9),
            "save_steps": 1 / checkpoints,
        }
    else:
        # The numbers of steps that the trainer computed from the shares when the run started.
        state = json.loads((checkpoint / STATE).read_text())
        steps = {name: state[name] for name in ("eval_steps", "save_steps")}
    return {
        "output_dir": str(run.folder),
        "seed": seed,
        "data_seed": seed,
        "learning_rate": train.lr,
        "lr_scheduler_type": SCHEDULES[train.schedule],
        "warmup_steps": train.warmup,
        "weight_decay": train.weight_decay,
        "adam_beta2": train.adam_beta2,
        "max_grad_norm": train.max_grad_norm,
        "num_train_epochs": train.epochs,
        "max_steps": train.max_steps,
        "bf16": train.precision == "bf16",
        "use_cpu": not torch.cuda.is_available(),
        **checkpointing_arguments(train.gradient_checkpointing),
        "eval_strategy": "steps",
        "save_strategy": "steps",
        **steps,
        # A resumed run already has the initial evaluation in its metrics.jsonl.
        "eval_on_start": checkpoint is None,
        "save_total_limit": train.keep_checkpoints,
        "logging_steps": 1,
        "dataloader_num_workers": train.workers,
        "dataloader_pin_memory": torch.cuda.is_available(),
        "remove_unused_columns": False,
        "report_to": list(train.report_to) or "none",
        "run_name": run.name,
        "project": PROJECT,
        "disable_tqdm": False,
    }


def run_training(
    trainer: Trainer, run: Run, checkpoint: Path | None, remedy: str, last_resort: str
) -> None:
    """Train from the start or a checkpoint, and keep the journal and the curves.

    Args:
        remedy: What to do if memory runs out, without changing the result of the run.
        last_resort: Settings to lower if this is not enough; they change the result.

    Raises:
        UserError: memory runs out, or a worker process or another rank raises a UserError.
    """
    add_callbacks(trainer, run)
    check_fsdp(trainer, checkpoint)
    advice = (
        f"{remedy} or set train.gradient_checkpointing=true, and run the same command, which goes "
        f"on from the last checkpoint; if this is not enough, lower {last_resort} in another run "
        "(run=NAME)"
    )
    with explain_errors("while training", advice):
        train_to_last_step(trainer, checkpoint)


def add_callbacks(trainer: Trainer, run: Run) -> None:
    """Add the progress bar and the journal, and set up W&B."""
    trainer.remove_callback(ProgressCallback)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(MetricsBar())
    if rank() == 0:
        trainer.add_callback(JournalCallback(run.folder))
    if "wandb" in trainer.args.report_to:
        # Keep W&B's files in the run's folder; a resumed run continues the same run at W&B.
        wandb = {"DIR": run.folder, "PROJECT": PROJECT, "RUN_ID": run_id(run), "RESUME": "allow"}
        for name, value in wandb.items():
            os.environ.setdefault(f"WANDB_{name}", str(value))


def train_to_last_step(trainer: Trainer, checkpoint: Path | None) -> None:
    """Train from the start or from a checkpoint. If the checkpoint is that of the last step, only
    load its weights."""
    if checkpoint is not None:
        log.info("resuming from %s", checkpoint)
        state = TrainerState.load_from_json(str(checkpoint / STATE))
        if state.global_step >= state.max_steps:
            # The trainer would train for one more step.
            trainer.state = state
            load_weights(trainer, checkpoint)
            return
    # Log lines are printed above the progress bar.
    with logging_redirect_tqdm():
        trainer.train(resume_from_checkpoint=str(checkpoint) if checkpoint else None)


@contextmanager
def explain_errors(when: str, advice: str) -> Iterator[None]:
    """Turn errors of the libraries that the user can correct into a UserError.

    Args:
        when: What the program is doing, such as "while training".
        advice: What to do if memory runs out.
    """
    try:
        with explain_out_of_memory(when, advice):
            yield
    except RuntimeError as error:
        if USER_ERROR_PREFIX not in str(error):
            raise
        # A UserError of another rank, whose traceback is part of the library's message.
        raise UserError(user_message(error), code="failed-rank") from error
    except UserError as error:
        raise UserError(user_message(error), code=error.code) from error


def explain_load_errors(group: str) -> AbstractContextManager[None]:
    """Return `explain_errors` for the loading of a model; `group` is student or retriever."""
    advice = f"set {group}.quantization=nf4, or give a smaller {group}.model"
    return explain_errors(f"while loading the {group}", advice)


def user_message(error: Exception) -> str:
    """Return an error's message without the traceback of a worker process or of another rank."""
    return str(error).rpartition(USER_ERROR_PREFIX)[2].strip()


def check_fsdp(trainer: Trainer, checkpoint: Path | None) -> None:
    """Raise UserError if the launcher requests FSDP that cannot be used, or if a run that was
    started with FSDP resumes without it, or the reverse."""
    fsdp = trainer.is_fsdp_enabled
    if is_sharded() and not fsdp:
        raise UserError(
            "accelerate uses FSDP on several GPUs only, and would train without it here: start "
            "without --use_fsdp; for several ranks, also on CPUs, give --multi_gpu",
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
            f"{checkpoint} was written {started} FSDP: resume the run {started} FSDP, on any "
            "number of ranks, or start another run with run=NAME",
            code="other-launch",
        )


def load_weights(trainer: Trainer, checkpoint: Path) -> None:
    """Load a checkpoint's weights without resuming from it."""
    if trainer.is_fsdp_enabled:
        # A sharded checkpoint needs a sharded model; accelerate shards a model with its optimizer.
        trainer.create_optimizer()
        trainer.accelerator.prepare(trainer.model, trainer.optimizer)
    trainer._load_from_checkpoint(str(checkpoint))


def gather_weights(trainer: Trainer) -> dict[str, torch.Tensor] | None:
    """Return the trained weights on the main rank if the model is sharded, else None."""
    if not trainer.is_fsdp_enabled:
        return None
    options = StateDictOptions(full_state_dict=True, cpu_offload=True, ignore_frozen_params=True)
    return get_model_state_dict(trainer.model, options=options)
