"""What both trainers share: arguments, the course of a run, resuming, and its end."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
from tqdm.contrib.logging import logging_redirect_tqdm
from transformers import (
    PrinterCallback,
    ProgressCallback,
    Trainer,
    TrainerCallback,
    TrainingArguments,
)
from transformers.trainer_callback import TrainerControl, TrainerState

from conf.entry import Run
from conf.errors import UserError
from conf.runs import rank, run_id
from conf.schema import TrainConfig
from models.distributed import is_sharded
from models.loading import unwritable_error
from models.memory import is_out_of_memory
from train.common.checkpoints import STATE, check_best
from train.common.journal import Bar, Journal, NamedMeasure

log = logging.getLogger(__name__)

PROJECT = "dynapix"
"""Under which trackers file a run."""
TOLD = f"{UserError.__module__}.{UserError.__qualname__}: "
"""Stands in a traceback before what a user can mend."""
SCHEDULES = {"cosine": "cosine", "linear": "linear", "constant": "constant_with_warmup"}


def arguments(train: TrainConfig, run: Run, seed: int, checkpoint: Path | None) -> dict[str, Any]:
    """Arguments for `TrainingArguments` and its kin, from the settings that trainers share."""
    if checkpoint is None:
        # A share of the steps; 1 would mean every step.
        every = min(1 / train.evaluations, 0.9999)
    else:
        every = json.loads((checkpoint / STATE).read_text())["eval_steps"]
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
        **checkpointing(train),
        "eval_strategy": "steps",
        "eval_steps": every,
        # A resumed run has its evaluation at the start in the journal already.
        "eval_on_start": checkpoint is None,
        "save_strategy": "steps",
        "save_steps": every,
        "save_total_limit": train.keep,
        "logging_steps": 1,
        "dataloader_num_workers": train.workers,
        "dataloader_pin_memory": torch.cuda.is_available(),
        "remove_unused_columns": False,
        # Here and not at the end alone: the best checkpoint is never thrown away.
        "load_best_model_at_end": train.best is not None,
        "metric_for_best_model": train.best,
        "report_to": list(train.report_to) or "none",
        "run_name": run.name,
        "project": PROJECT,
        "disable_tqdm": False,
    }


def checkpointing(train: TrainConfig) -> dict[str, Any]:
    """Recomputing activations, under the name that this version of transformers has for it."""
    if not train.gradient_checkpointing:
        return {}
    named = {field.name for field in fields(TrainingArguments)}
    new = "activation_checkpointing" in named
    name = "activation_checkpointing" if new else "gradient_checkpointing"
    return {name: True, f"{name}_kwargs": {"use_reentrant": False}}


def prefetched(workers: int, batches: int) -> int | None:
    """Batches that each worker makes ahead: together at least the `batches` of a step, which the
    trainer asks for all at once, so that they are made while the step before is computed."""
    return max(2, math.ceil(batches / workers)) if workers else None


def train_and_log(trainer: Trainer, run: Run, checkpoint: Path | None, lower: str) -> int | None:
    """Train from the start or a checkpoint, writing the journal and the curves. Where train.best
    names a measure, the trainer's model is the best checkpoint's in the end, whose step is given.

    Raises:
        UserError: memory runs out (`lower` says by which keys less of it is taken), the disk takes
            no checkpoint, no evaluation has the named measure, or whatever else a user can mend,
            also where a worker process found it.
    """
    watch(trainer, run)
    check_fsdp(trainer, checkpoint)
    with explained(run.folder, lambda: f"after step {trainer.state.global_step}", lower):
        fit(trainer, checkpoint)
    best = trainer.state.best_global_step
    if best:
        named = f"{trainer.args.metric_for_best_model} is best, {trainer.state.best_metric:.4g}"
        log.info("what is kept is the checkpoint of step %d, where %s", best, named)
    return best


def watch(trainer: Trainer, run: Run) -> None:
    """Have the run's progress shown, kept and sent to its trackers."""
    trainer.remove_callback(ProgressCallback)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(Bar())
    if rank() == 0:
        trainer.add_callback(Journal(run.folder))
    trainer.add_callback(NamedMeasure())
    trainer.add_callback(BestCheckpoint())
    if "wandb" in trainer.args.report_to:
        # What it keeps on disk belongs to the run, and a run that goes on is the same run there;
        # TensorBoard's files are there by themselves.
        wandb = {"DIR": run.folder, "PROJECT": PROJECT, "RUN_ID": run_id(run), "RESUME": "allow"}
        for name, value in wandb.items():
            os.environ.setdefault(f"WANDB_{name}", str(value))


class BestCheckpoint(TrainerCallback):
    """Has every rank know the best checkpoint by its step. The library looks for its folder while
    it is written: where a model is written in parts (FSDP) that is too early, so that an earlier
    checkpoint stays the best, or one rank finds it and another does not, and they wait for each
    other for ever in the end."""

    def on_save(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        if state.best_global_step:
            folder = Path(args.output_dir, f"checkpoint-{state.best_global_step}")
            state.best_model_checkpoint = str(folder)


class Epochs(TrainerCallback):
    """Tells each of those that follow it which epoch it is: what a run that goes on within an epoch
    skips hides the sampler from the library, which would tell it nothing."""

    def __init__(self, *followers: Any) -> None:
        self._followers = followers

    def on_epoch_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        # A resumed run goes on within an epoch.
        for follower in self._followers:
            follower.set_epoch(int(state.epoch or 0))


def fit(trainer: Trainer, checkpoint: Path | None) -> None:
    """Train to the last step, from the start or a checkpoint."""
    if checkpoint is not None:
        check_best(checkpoint)
        log.info("going on from %s", checkpoint)
    if checkpoint is not None and is_last(checkpoint):
        # The trainer would take a step more.
        trainer.state = TrainerState.load_from_json(str(checkpoint / STATE))
        best = trainer.state.best_global_step or trainer.state.global_step
        load(trainer, checkpoint.with_name(f"checkpoint-{best}"))
        return
    # What is told meanwhile stands above the bar.
    with logging_redirect_tqdm():
        trainer.train(resume_from_checkpoint=str(checkpoint) if checkpoint else None)


@contextmanager
def explained(folder: Path, when: Callable[[], str], lower: str) -> Iterator[None]:
    """Turn what the libraries raise at a user's machine into what its user can do: `when` tells how
    far it came, and `lower` by which keys less memory is taken."""
    try:
        yield
    except SafetensorError as error:
        raise unwritable_error(folder, str(error)) from error
    except RuntimeError as error:
        if is_unwritten(error):
            raise unwritable_error(folder, "a file was cut short; the disk may be full") from error
        if TOLD in str(error):
            # Of another rank, which the library tells with its traceback.
            raise UserError(sentence(error)) from error
        if not is_out_of_memory(error):
            raise
        raise UserError(f"out of memory {when()}: {lower}") from error
    except UserError as error:
        raise UserError(sentence(error)) from error


def loading(folder: Path, group: str) -> AbstractContextManager[None]:
    """As `explained`, where a student or retriever is loaded."""
    less = f"set {group}.quantization=nf4, or give a smaller {group}.model"
    return explained(folder, lambda: f"as the {group} was loaded", less)


def sentence(error: Exception) -> str:
    """An error's own words: torch puts a worker's traceback before them, all in one text."""
    return str(error).rpartition(TOLD)[2].strip()


def is_last(checkpoint: Path) -> bool:
    """Whether a checkpoint is that of a run's last step."""
    state = json.loads((checkpoint / STATE).read_text())
    return state["global_step"] >= state["max_steps"]


def check_fsdp(trainer: Trainer, checkpoint: Path | None) -> None:
    """Raises UserError where the FSDP that a launcher was told of is none that trains here, or a
    run was begun with it and goes on without, or the reverse."""
    fsdp = trainer.is_fsdp_enabled
    if is_sharded() and not fsdp:
        raise UserError(
            "accelerate has FSDP for several GPUs only, and would train without a word about it: "
            "leave --use_fsdp away (and give --multi_gpu, on CPUs too)"
        )
    if fsdp and trainer.accelerator.state.fsdp_plugin.fsdp_version != 2:
        raise UserError("of FSDP only the second version trains adapters: give --fsdp_version 2")
    if checkpoint is not None and any(checkpoint.glob("pytorch_model_fsdp*")) != fsdp:
        begun = "without" if fsdp else "with"
        raise UserError(
            f"{checkpoint} was written {begun} FSDP: start the run {begun} it again, on as many "
            "ranks as you like, or begin another one with run=NAME"
        )


def load(trainer: Trainer, checkpoint: Path) -> None:
    """Take a checkpoint's weights without training on from it."""
    if trainer.is_fsdp_enabled:
        # A model in parts takes its parts, and accelerate parts it with its optimizer.
        trainer.create_optimizer()
        trainer.accelerator.prepare(trainer.model, trainer.optimizer)
    trainer._load_from_checkpoint(str(checkpoint))


def gathered(trainer: Trainer) -> dict[str, torch.Tensor] | None:
    """What was trained, on the main rank, where FSDP gave each rank a part of it; else None."""
    if not trainer.is_fsdp_enabled:
        return None
    # A frozen base is where it was.
    options = StateDictOptions(full_state_dict=True, cpu_offload=True, ignore_frozen_params=True)
    return get_model_state_dict(trainer.model, options=options)


def is_unwritten(error: RuntimeError) -> bool:
    """Whether torch could not write a file whole; it has no other sign of a full disk."""
    return "PytorchStreamWriter" in str(error) or "unexpected pos" in str(error)


def check_not_empty(samples: int, what: str) -> None:
    """Raises UserError where nothing is left to train on."""
    if samples == 0:
        raise UserError(
            f"there are no {what} to train on or measure: look at the shortfalls that python -m "
            "data.build prints and at the rejects that python -m teacher.narrate prints"
        )
