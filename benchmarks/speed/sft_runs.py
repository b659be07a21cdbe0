"""Short trainings of one student by `train.sft`'s trainer and by TRL's SFTTrainer, on the same
samples in the same order with the same hyperparameters, and what they took.

TRL gets what its user can give it: the base in the same precision, the same adapters, the library's
own attention, and our prompts by a collator of the user's, since its own shows no videos. Samples
sorted by length within a step and adapters over the language tower alone it gets as a gift. It
packs no vision samples, nor pads none, and turns adapters over 4-bit weights into bf16.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import nn
from torch.utils.data import Dataset, SequentialSampler, Subset
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
    """A trainer and its switches.

    `attention` is one of transformers' implementations, None what the trainer's user gets without
    asking. `collator` is ours; of our trainer's "every row", which lets unsupervised rows pass the
    head too; of TRL's its "own", for samples that show images alone.
    """

    name: str
    trainer: str = "ours"
    micro_batch: int = 8
    recompute: bool = False
    workers: int = 0
    packing: str = "auto"
    reuse: bool = False
    attention: str | None = None
    collator: str = "ours"
    environment: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Work:
    """A student on its device, and the samples of all steps in their order."""

    model: nn.Module
    processor: ProcessorMixin
    samples: Subset
    train: SftTrainConfig
    max_length: int


@dataclass(frozen=True)
class Figures:
    """Seconds of each step after the first, with the making of its samples; the loss that each step
    logged; the most memory that was held meanwhile, on a CPU by the process (GiB)."""

    seconds: list[float]
    losses: list[float]
    peak: float


def run(variant: Variant, work: Work, steps: int, folder: Path, **settings: Any) -> Figures:
    """Train `steps` steps in `folder`."""
    train = replace(
        work.train,
        max_steps=steps,
        micro_batch=variant.micro_batch,
        gradient_checkpointing=variant.recompute,
        workers=variant.workers,
        packing=variant.packing,
        reuse_features=variant.reuse,
    )
    clock = Clock(next(work.model.parameters()).device)
    build = {"ours": ours, "trl": trls}[variant.trainer]
    trainer = build(variant, replace(work, train=train), clock, folder, **settings)
    trainer.remove_callback(PrinterCallback)
    trainer.train()
    return Figures(clock.seconds(), clock.losses, clock.peak)


def ours(
    variant: Variant,
    work: Work,
    clock: Clock,
    folder: Path,
    loss: Callable[..., torch.Tensor] = token_mean,
) -> Trainer:
    """The trainer as `train.sft` makes it, without evaluations and checkpoints."""
    train = work.train
    fuse(work.model)
    if variant.attention is not None:
        work.model.get_base_model().set_attn_implementation(variant.attention)
    kind = EveryRow if variant.collator == "every row" else Collator
    collator = kind(work.processor, work.max_length)
    rope = packing_rope(work.model, train.packing)
    packs = rope and PackingCollator(work.processor, work.max_length, rope)
    cache = None
    if train.reuse_features:
        cache = VisionCache(work.model, train.precision, available_cpu_bytes() // 2)
    accumulation = train.batch // train.micro_batch
    common = common_arguments(train, Run("benchmark", folder), SEED, None)
    never = {"eval_strategy": "no", "eval_on_start": False, "save_strategy": "no"}
    return StudentTrainer(
        model=work.model,
        args=TrainingArguments(
            **{**common, **never, "disable_tqdm": True},
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=accumulation,
            dataloader_prefetch_factor=prefetch_factor(train.workers, accumulation),
            label_names=["labels"],
        ),
        data_collator=TrainerCollator(collator, cache is not None),
        training_collator=TrainerCollator(packs or collator, cache is not None),
        train_dataset=work.samples,
        compute_loss_func=loss,
        callbacks=[clock],
        sampler=SequentialSampler(work.samples),
        accuracy=LetterAccuracy(letter_ids(work.processor)),
        vision_cache=cache,
    )


def trls(variant: Variant, work: Work, clock: Clock, folder: Path) -> Trainer:
    """TRL's trainer, as SFTConfig comes in all that a variant and the hyperparameters leave open.
    It takes rows of `datasets` only, so a row is the place of its sample."""
    import datasets
    from trl import SFTConfig, SFTTrainer

    train, own = work.train, variant.collator == "own"
    unfuse(work.model)
    work.model.get_base_model().set_attn_implementation(variant.attention or "sdpa")
    rows = datasets.Dataset.from_dict({"row": range(len(work.samples))})
    collator = EveryRow(work.processor, work.max_length)
    if own:
        rows = rows.with_transform(partial(shown, work.samples))
    return SFTTrainer(
        model=work.model,
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
            # Its default of 1,024 tokens would cut into images.
            max_length=work.max_length,
            dataset_kwargs={"skip_prepare_dataset": True},
            remove_unused_columns=False,
            logging_steps=1,
            save_strategy="no",
            report_to="none",
            disable_tqdm=True,
        ),
        data_collator=None if own else partial(collator.rows, work.samples),
        train_dataset=rows,
        processing_class=work.processor,
        callbacks=[clock],
    )


class EveryRow(Collator):
    """Makes batches in which every position has a label and passes the head."""

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length) for s in samples]
        return pad(encoded, self._processor.tokenizer.pad_token_id)

    def rows(self, samples: Subset, rows: Sequence[dict[str, int]]) -> dict[str, Any]:
        """A batch of the samples at `rows`. TRL's head takes those positions that are supervised
        by itself."""
        return self([samples[row["row"]] for row in rows])


def shown(samples: Subset, rows: dict[str, list[int]]) -> dict[str, list[Any]]:
    """Rows in the form that TRL's own collator reads: a prompt, a completion and their images."""
    told = [samples[row] for row in rows["row"]]
    return {
        "images": [[Image.fromarray(image) for image in sample.images] for sample in told],
        "prompt": [[{"role": "user", "content": sample.content}] for sample in told],
        "completion": [[{"role": "assistant", "content": sample.response}] for sample in told],
    }


class AsImages(Dataset):
    """Samples that show their clips' frames as images: without times, in twice the tokens."""

    def __init__(self, samples: Dataset) -> None:
        self._samples = samples

    def __getitem__(self, index: int) -> Sample:
        sample = self._samples[index]
        assert sample.clip is not None
        frames = list(sample.clip.pixels)
        content = [{"type": "image"}] * len(frames) + sample.content[1:]
        return replace(sample, content=content, clip=None, images=[*frames, *sample.images])


class Clock(TrainerCallback):
    """When each step ended, what it logged, and the memory of all."""

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
