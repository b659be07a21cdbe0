"""What both trainers share: arguments, journal, progress, resuming, and the end of a run."""

from __future__ import annotations

import json
import logging
import math
import os
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch.distributed.checkpoint.state_dict import StateDictOptions, get_model_state_dict
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
from conf.processes import visible_gpus
from conf.runs import rank, write_text
from conf.schema import TrainConfig
from conf.sweep import AT_START
from train.plots import curves_figure

log = logging.getLogger(__name__)

JOURNAL = "metrics.jsonl"
UNSHARED = ("_runtime", "_per_second", "total_flos", "train_loss")
"""Ends of the logged names that no two runs share: timings, and the trainer's mean over the run,
which counts only the steps since it was resumed."""

SCHEDULES = {"cosine": "cosine", "linear": "linear", "constant": "constant_with_warmup"}


def arguments(train: TrainConfig, run: Run, seed: int, checkpoint: Path | None) -> dict[str, Any]:
    """Arguments for `TrainingArguments` and its kin, from the settings that trainers share."""
    if checkpoint is None:
        # A share of the steps; 1 would mean every step.
        every = min(1 / train.evaluations, 0.9999)
    else:
        every = json.loads((checkpoint / "trainer_state.json").read_text())["eval_steps"]
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
        "report_to": list(train.report_to) or "none",
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


def keep_to_one_gpu() -> None:
    """See the first GPU alone where no launcher has started several ranks: the trainer would spread
    each micro-batch over all of them, and train on more samples a step than the settings say."""
    gpus = visible_gpus()
    if len(gpus) > 1 and "LOCAL_RANK" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[0]
        log.info("training on GPU %s of %d; several take accelerate launch", gpus[0], len(gpus))


def train_and_log(trainer: Trainer, run: Run, checkpoint: Path | None, lower: str) -> None:
    """Train from the start or a checkpoint, writing the journal and the curves.

    Raises:
        UserError: memory runs out; `lower` says by which key less of it is taken. Or whatever
            else a user can mend, also where a worker process found it.
    """
    trainer.remove_callback(ProgressCallback)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(Bar())
    if rank() == 0:
        trainer.add_callback(Journal(run.folder))
    check_fsdp(trainer, checkpoint)
    if checkpoint is not None:
        log.info("going on from %s", checkpoint)
    try:
        if checkpoint is not None and is_last(checkpoint):
            # The trainer would take a step more.
            load(trainer, checkpoint)
        else:
            trainer.train(resume_from_checkpoint=str(checkpoint) if checkpoint else None)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(
            f"out of memory after step {trainer.state.global_step}: lower {lower}, or set "
            "train.gradient_checkpointing=true, in a run of its own (run=NAME)"
        ) from error
    except UserError as error:
        raise UserError(sentence(error)) from error
    if rank() == 0:
        curves_figure(read_journal(run.folder), run.folder / "curves.png")


def sentence(error: UserError) -> str:
    """An error's own words: torch puts a worker's traceback before them, all in one text."""
    name = f"{UserError.__module__}.{UserError.__qualname__}: "
    return str(error).rpartition(name)[2].strip()


def is_last(checkpoint: Path) -> bool:
    """Whether a checkpoint is that of a run's last step."""
    state = json.loads((checkpoint / "trainer_state.json").read_text())
    return state["global_step"] >= state["max_steps"]


def check_fsdp(trainer: Trainer, checkpoint: Path | None) -> None:
    """Raises UserError where the FSDP that a launcher was told of is none that trains here, or a
    run was begun with it and goes on without, or the reverse."""
    fsdp = trainer.is_fsdp_enabled
    if os.environ.get("ACCELERATE_USE_FSDP") == "true" and not fsdp:
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


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether a card's or the machine's memory was too small."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def evaluated(folder: Path) -> dict[str, float]:
    """First and last value of everything that a run evaluated: `<name>` and `<name>_at_start`."""
    records = [r for r in read_journal(folder) if any(k.startswith("eval_") for k in r)]
    results: dict[str, float] = {}
    for record in records:
        for key, value in record.items():
            if key.startswith("eval_"):
                name = key.removeprefix("eval_")
                results.setdefault(f"{name}{AT_START}", value)
                results[name] = value
    return results


class Journal(TrainerCallback):
    """Appends what the trainer logs to the run's metrics.jsonl, and on resuming drops the lines
    past the checkpoint, so that the file is that of an undisturbed run."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        kept = [r for r in read_journal(self._path.parent) if r["step"] <= state.global_step]
        resumed = state.global_step > 0
        lines = [json.dumps(r) + "\n" for r in kept] if resumed else []
        write_text(self._path, "".join(lines))

    def on_log(self, args, state: TrainerState, control: TrainerControl, logs=None, **_) -> None:
        values = {k: v for k, v in (logs or {}).items() if not k.endswith(UNSHARED)}
        if not values.keys() - {"epoch"}:
            return
        with open(self._path, "a") as file:
            file.write(json.dumps({"step": state.global_step, **values}) + "\n")


class Bar(ProgressCallback):
    """The trainer's bar with its newest figures in it."""

    SHOWN = ("loss", "accuracy", "recall@10")

    def __init__(self, max_str_len: int = 100) -> None:
        super().__init__(max_str_len)
        self._figures: dict[str, str] = {}

    def on_prediction_step(self, args, state, control, **_) -> None:
        """An evaluation's own bar would break the line of the run's."""

    def on_log(self, args, state, control, logs=None, **_) -> None:
        for name, value in (logs or {}).items():
            if name.endswith(self.SHOWN) and not name.endswith(UNSHARED):
                self._figures[name.removeprefix("eval_")] = f"{value:.3g}"
        if self.training_bar is not None:
            self.training_bar.set_postfix(self._figures)


def read_journal(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics.jsonl; one torn by a kill is passed over."""
    path = folder / JOURNAL
    if not path.exists():
        return []
    records = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and "step" in record:
            records.append(record)
    return records


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest whole checkpoint below a run's folder. The trainer writes its state last, so a
    checkpoint without a readable one was cut off."""
    named = [(re.fullmatch(r"checkpoint-(\d+)", p.name), p) for p in folder.glob("checkpoint-*")]
    for _, path in sorted(((int(m[1]), p) for m, p in named if m), reverse=True):
        try:
            json.loads((path / "trainer_state.json").read_text())
        except (OSError, ValueError):
            log.warning("%s was cut off: going on from the one before it", path)
            continue
        return path
    return None


def check_not_empty(samples: int, what: str) -> None:
    """Raises UserError where nothing is left to train on."""
    if samples == 0:
        raise UserError(
            f"there are no {what} to train on or measure: look at the shortfalls that python -m "
            "data.build prints and at the rejects that python -m teacher.narrate prints"
        )
