"""Train a student for a few steps with the trainer of `train.sft` or with TRL's SFTTrainer.

Both trainers use the same base in the same precision, the same adapters, samples, order of samples
and hyperparameters. The adapters are on the language tower only, and the order of `train.sft`
groups samples of similar length. TRL uses its default attention, and our collator because its own
does not support videos. TRL does not pack samples with images, and casts adapters over 4-bit
weights to bf16.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import SequentialSampler, Subset
from transformers import (
    PrinterCallback,
    ProcessorMixin,
    Trainer,
    TrainerCallback,
    TrainingArguments,
)

from benchmarks.speed.peak_memory import peak_bytes, reset_peak
from conf.entry import Run
from conf.schema import SftTrainConfig
from models.lora_kernels import fuse, unfuse
from models.memory import available_cpu_bytes
from models.student.collator import Collator, encode, letter_ids, pad
from models.student.prompts import Sample
from train.common.arguments import SCHEDULES, common_arguments, prefetch_factor
from train.student.metrics import LetterAccuracy
from train.student.packing import PackingCollator, packing_rope
from train.student.regimes import TrainerCollator
from train.student.trainer import StudentTrainer, token_mean
from train.student.vision_cache import VisionCache

SEED = 0


@dataclass(frozen=True)
class Variant:
    """A trainer and its settings.

    Attributes:
        trainer: "ours" or "trl".
        micro_batch: Samples per forward pass.
        recompute: Whether activations are recomputed in the backward pass.
        workers: Worker processes of the data loader.
        packing: As `train.packing` (ours only).
        reuse: Whether the frozen vision tower's features are cached (ours only).
        attention: An attention implementation of transformers, or None for the trainer's default.
        every_row: Whether logits are computed at unsupervised positions too (ours only).
    """

    name: str
    trainer: str = "ours"
    micro_batch: int = 8
    recompute: bool = False
    workers: int = 0
    packing: str = "auto"
    reuse: bool = False
    attention: str | None = None
    every_row: bool = False


@dataclass(frozen=True)
class Student:
    """A student on its device, its training samples in order over all steps, and its settings."""

    model: nn.Module
    processor: ProcessorMixin
    samples: Subset
    train: SftTrainConfig
    max_length: int


@dataclass(frozen=True)
class Figures:
    """Measurements of one training.

    Attributes:
        seconds: Duration of each step after the first, including the loading of its samples.
        losses: Loss of each step.
        peak: Peak memory in GiB, of tensors on the GPU or of the process on a CPU.
    """

    seconds: list[float]
    losses: list[float]
    peak: float


def train(variant: Variant, student: Student, steps: int, folder: Path, **options: Any) -> Figures:
    """Train for `steps` steps and measure them; `options` are passed to the trainer's builder."""
    settings = replace(
        student.train,
        max_steps=steps,
        micro_batch=variant.micro_batch,
        gradient_checkpointing=variant.recompute,
        workers=variant.workers,
        packing=variant.packing,
        reuse_features=variant.reuse,
    )
    clock = Clock(next(student.model.parameters()).device)
    build = {"ours": own_trainer, "trl": trl_trainer}[variant.trainer]
    trainer = build(variant, replace(student, train=settings), clock, folder, **options)
    trainer.remove_callback(PrinterCallback)
    trainer.train()
    return Figures(clock.seconds(), clock.losses, clock.peak)


def own_trainer(
    variant: Variant,
    student: Student,
    clock: Clock,
    folder: Path,
    loss: Callable[..., torch.Tensor] = token_mean,
) -> Trainer:
    """Return the trainer that `train.sft` builds, without evaluations and checkpoints."""
    train = student.train
    fuse(student.model)
    if variant.attention is not None:
        student.model.get_base_model().set_attn_implementation(variant.attention)
    kind = EveryRow if variant.every_row else Collator
    collator = kind(student.processor, student.max_length)
    rope = packing_rope(student.model, train.packing)
    packs = rope and PackingCollator(student.processor, student.max_length, rope)
    cache = None
    if train.reuse_features:
        cache = VisionCache(student.model, train.precision, available_cpu_bytes() // 2)
    accumulation = train.batch // train.micro_batch
    common = common_arguments(train, Run("benchmark", folder), SEED, None)
    never = {"eval_strategy": "no", "eval_on_start": False, "save_strategy": "no"}
    return StudentTrainer(
        model=student.model,
        args=TrainingArguments(
            **{**common, **never, "disable_tqdm": True},
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=accumulation,
            dataloader_prefetch_factor=prefetch_factor(train.workers, accumulation),
            label_names=["labels"],
        ),
        data_collator=TrainerCollator(collator, cache is not None),
        training_collator=TrainerCollator(packs or collator, cache is not None),
        train_dataset=student.samples,
        compute_loss_func=loss,
        callbacks=[clock],
        sampler=SequentialSampler(student.samples),
        accuracy=LetterAccuracy(letter_ids(student.processor)),
        vision_cache=cache,
    )


def trl_trainer(variant: Variant, student: Student, clock: Clock, folder: Path) -> Trainer:
    """Return TRL's trainer with the variant's settings and the student's hyperparameters.

    All other settings have the defaults of SFTConfig. TRL accepts only a dataset of the `datasets`
    library, so the dataset contains sample indices and the collator looks up the samples.
    """
    import datasets
    from trl import SFTConfig, SFTTrainer

    train = student.train
    unfuse(student.model)
    student.model.get_base_model().set_attn_implementation(variant.attention or "sdpa")
    rows = datasets.Dataset.from_dict({"row": range(len(student.samples))})
    collator = EveryRow(student.processor, student.max_length)
    return SFTTrainer(
        model=student.model,
        args=SFTConfig(
            output_dir=str(folder),
            seed=SEED,
            learning_rate=train.lr,
            lr_scheduler_type=SCHEDULES[train.schedule],
            warmup_steps=train.warmup,
            weight_decay=train.weight_decay,
            adam_beta2=train.adam_beta2,
            max_grad_norm=train.max_grad_norm,
            max_steps=train.max_steps,
            bf16=train.precision == "bf16",
            use_cpu=not torch.cuda.is_available(),
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=train.batch // train.micro_batch,
            gradient_checkpointing=train.gradient_checkpointing,
            dataloader_num_workers=train.workers,
            dataloader_pin_memory=torch.cuda.is_available(),
            train_sampling_strategy="sequential",
            # The default of 1,024 tokens would truncate within an image.
            max_length=student.max_length,
            dataset_kwargs={"skip_prepare_dataset": True},
            remove_unused_columns=False,
            logging_steps=1,
            save_strategy="no",
            report_to="none",
            disable_tqdm=True,
        ),
        data_collator=partial(collator.rows, student.samples),
        train_dataset=rows,
        processing_class=student.processor,
        callbacks=[clock],
    )


class EveryRow(Collator):
    """Makes batches with labels and logits at every position; prompt tokens have label IGNORED."""

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length) for s in samples]
        return pad(encoded, self._processor.tokenizer.pad_token_id)

    def rows(self, samples: Subset, rows: Sequence[dict[str, int]]) -> dict[str, Any]:
        """Collate the samples whose indices are in `rows`."""
        return self([samples[row["row"]] for row in rows])


class Clock(TrainerCallback):
    """Records the end time and the loss of each step, and the peak memory."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.ends: list[float] = []
        self.losses: list[float] = []
        self.peak = 0.0

    def on_train_begin(self, *_: Any, **__: Any) -> None:
        reset_peak(self._device)

    def on_step_end(self, *_: Any, **__: Any) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize()
        self.ends.append(time.perf_counter())

    def on_log(self, args, state, control, logs=None, **_: Any) -> None:
        if "loss" in (logs or {}):
            self.losses.append(logs["loss"])

    def on_train_end(self, *_: Any, **__: Any) -> None:
        self.peak = peak_bytes(self._device) / 2**30

    def seconds(self) -> list[float]:
        return [end - start for start, end in pairwise(self.ends)]


def device_name() -> str:
    if torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"a CPU with {torch.get_num_threads()} threads"
