"""Convert settings of training to the arguments of transformers' Trainer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from dynapix.conf.runs import Run
from dynapix.conf.schema import TrainConfig
from dynapix.models.compat import checkpointing_arguments
from dynapix.train.common.checkpoints import STATE

PROJECT = "dynapix"
"""Name of the project in experiment trackers."""
SCHEDULES = {"cosine": "cosine", "linear": "linear", "constant": "constant_with_warmup"}
"""The name in transformers of each value of train.schedule."""
MIN_CHECKPOINTS = 2
"""Minimum number of checkpoints of a run, so that a killed run loses at most half of it."""


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
            "eval_steps": min(1 / train.evaluations, 0.9999),
            "save_steps": min(1 / checkpoints, 0.9999),
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
