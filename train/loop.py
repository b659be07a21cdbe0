"""What both trainers share: arguments, journal, progress, resuming, and the end of a run."""

from __future__ import annotations

import json
import logging
import math
import os
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
from conf.processes import visible_gpus
from conf.runs import rank, write_text
from conf.schema import TrainConfig
from conf.sweep import AT_START
from train.backbone import unwritten
from train.checkpoints import STATE
from train.plots import curves_figure

log = logging.getLogger(__name__)

JOURNAL = "metrics.jsonl"
WRITTEN = "samples.jsonl"
"""What a student wrote at each evaluation of its run, one JSON line an answer."""
BEST_STEP = "best_step"
"""Name of the step whose checkpoint a run kept, among what it evaluated."""
UNSHARED = ("_runtime", "_per_second", "total_flos", "train_loss")
"""Ends of the logged names that no two runs share: timings, and the trainer's mean over the run,
which counts only the steps since it was resumed."""

PROJECT = "dynapix"
"""Under which trackers file a run."""
SHOWN = {
    "generated_parse_rate": "parsed",
    "generated_accuracy": "right",
    "letter_accuracy": "letter",
    "token_accuracy": "token",
    "loss": "loss",
    "recall@10": "recall@10",
}
"""What the bar shows, by the end of its name, and what it is called there."""

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


def keep_to_one_gpu() -> None:
    """See the first GPU alone where no launcher has started several ranks: the trainer would spread
    each micro-batch over all of them, and train on more samples a step than the settings say."""
    gpus = visible_gpus()
    if len(gpus) > 1 and "LOCAL_RANK" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[0]
        log.info("training on GPU %s of %d; several take accelerate launch", gpus[0], len(gpus))


def train_and_log(trainer: Trainer, run: Run, checkpoint: Path | None, lower: str) -> int | None:
    """Train from the start or a checkpoint, writing the journal and the curves. Where train.best
    names a measure, the trainer's model is the best checkpoint's in the end, whose step is given.

    Raises:
        UserError: memory runs out (`lower` says by which key less of it is taken), the disk takes
            no checkpoint, no evaluation has the named measure, or whatever else a user can mend,
            also where a worker process found it.
    """
    trainer.remove_callback(ProgressCallback)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(Bar())
    if rank() == 0:
        trainer.add_callback(Journal(run.folder))
    trainer.add_callback(NamedMeasure())
    check_fsdp(trainer, checkpoint)
    # What a tracker keeps on disk belongs to the run; TensorBoard's is there by itself.
    os.environ.setdefault("WANDB_DIR", str(run.folder))
    os.environ.setdefault("WANDB_PROJECT", PROJECT)
    if checkpoint is not None:
        log.info("going on from %s", checkpoint)
    try:
        if checkpoint is not None and is_last(checkpoint):
            # The trainer would take a step more.
            trainer.state = TrainerState.load_from_json(str(checkpoint / STATE))
            best = trainer.state.best_global_step or trainer.state.global_step
            load(trainer, checkpoint.with_name(f"checkpoint-{best}"))
        else:
            # What is told meanwhile stands above the bar.
            with logging_redirect_tqdm():
                trainer.train(resume_from_checkpoint=str(checkpoint) if checkpoint else None)
    except SafetensorError as error:
        raise unwritten(run.folder, str(error)) from error
    except RuntimeError as error:
        if is_unwritten(error):
            raise unwritten(run.folder, "a file was cut short; the disk may be full") from error
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
    best = trainer.state.best_global_step
    if best:
        named = f"{trainer.args.metric_for_best_model} is best, {trainer.state.best_metric:.4g}"
        log.info("what is kept is the checkpoint of step %d, where %s", best, named)
    return best


def sentence(error: UserError) -> str:
    """An error's own words: torch puts a worker's traceback before them, all in one text."""
    name = f"{UserError.__module__}.{UserError.__qualname__}: "
    return str(error).rpartition(name)[2].strip()


def is_last(checkpoint: Path) -> bool:
    """Whether a checkpoint is that of a run's last step."""
    state = json.loads((checkpoint / STATE).read_text())
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


def is_unwritten(error: RuntimeError) -> bool:
    """Whether torch could not write a file whole; it has no other sign of a full disk."""
    return "PytorchStreamWriter" in str(error) or "unexpected pos" in str(error)


def evaluated(folder: Path, best: int | None = None) -> dict[str, float]:
    """What a run evaluated at first and of what it kept: `<name>_at_start` and `<name>`. What it
    kept is that of its last step, or of the step `best`, which is then given too."""
    records = [r for r in read_journal(folder) if any(k.startswith("eval_") for k in r)]
    results: dict[str, float] = {}
    if best is not None:
        records = [r for r in records if r["step"] <= best]
        results[BEST_STEP] = float(best)
    for record in records:
        for key, value in record.items():
            if key.startswith("eval_"):
                name = key.removeprefix("eval_")
                results.setdefault(f"{name}{AT_START}", value)
                results[name] = value
    return results


class Journal(TrainerCallback):
    """Appends what the trainer logs to the run's metrics.jsonl, and on resuming drops the lines
    past the checkpoint from it and from samples.jsonl, so that both are an undisturbed run's."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        resumed = state.global_step > 0
        for path in (self._path, self._path.with_name(WRITTEN)):
            kept = [r for r in read_lines(path) if resumed and r["step"] <= state.global_step]
            if kept or path.exists():
                write_text(path, "".join(json.dumps(r) + "\n" for r in kept))

    def on_log(self, args, state: TrainerState, control: TrainerControl, logs=None, **_) -> None:
        values = {k: v for k, v in (logs or {}).items() if not k.endswith(UNSHARED)}
        if not values.keys() - {"epoch"}:
            return
        with open(self._path, "a") as file:
            file.write(json.dumps({"step": state.global_step, **values}) + "\n")


class NamedMeasure(TrainerCallback):
    """Holds train.best against what the evaluation at the start measured, before the first step."""

    def on_step_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        best = args.metric_for_best_model
        if best is None or state.best_global_step:
            return
        names = {k for r in state.log_history for k in r if k.startswith("eval_")}
        names = sorted(k for k in names if not k.endswith((*UNSHARED, "_preparation_time")))
        if f"eval_{best.removeprefix('eval_')}" not in names:
            raise UserError(
                f"train.best={best} is nothing that an evaluation of this run measures; the "
                f"options are {', '.join(names)}"
            )


class Bar(ProgressCallback):
    """The trainer's bar with its newest figures in it."""

    def __init__(self, max_str_len: int = 100) -> None:
        super().__init__(max_str_len)
        self._figures: dict[str, dict[str, str]] = {"": {}}

    def on_prediction_step(self, args, state, control, **_) -> None:
        """An evaluation's own bar would break the line of the run's."""

    def on_log(self, args, state, control, logs=None, **_) -> None:
        for name, value in (logs or {}).items():
            shown = next((end for end in SHOWN if name.endswith(end)), None)
            if shown and not name.endswith(UNSHARED):
                mode = name.removesuffix(shown).removeprefix("eval_").strip("_")
                self._figures.setdefault(mode, {})[SHOWN[shown]] = f"{value:.3g}"
        if self.training_bar is not None:
            told = [
                " ".join([mode, *(f"{name}={value}" for name, value in figures.items())]).strip()
                for mode, figures in self._figures.items()
                if figures
            ]
            self.training_bar.set_postfix_str(", ".join(told))


def read_journal(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics.jsonl; one torn by a kill is passed over."""
    return read_lines(folder / JOURNAL)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON lines of a file that tell their step."""
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


def check_not_empty(samples: int, what: str) -> None:
    """Raises UserError where nothing is left to train on."""
    if samples == 0:
        raise UserError(
            f"there are no {what} to train on or measure: look at the shortfalls that python -m "
            "data.build prints and at the rejects that python -m teacher.narrate prints"
        )
