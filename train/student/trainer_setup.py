"""Build a student's trainer from its settings."""

from __future__ import annotations

import logging
import math
from pathlib import Path

from torch import nn
from transformers import ProcessorMixin, TrainingArguments

from dynapix.conf.runs import Run, local_world_size, world_size
from dynapix.conf.schema import SftCommand, StudentTrainConfig
from dynapix.models.distributed import split_batch
from dynapix.models.layers.shared_prompts import shares_prompts
from dynapix.models.memory import available_cpu_bytes
from dynapix.models.student.chat_format import takes_clips
from dynapix.models.student.collator import Collator, letter_ids
from dynapix.train.common.arguments import common_arguments
from dynapix.train.common.audit import audit_student
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.student.held_out_answers import HeldOutAnswers
from dynapix.train.student.lazy_samples import StudentDataset
from dynapix.train.student.length_sampler import LengthSampler
from dynapix.train.student.metrics import LetterAccuracy
from dynapix.train.student.trainer import LOSSES, StudentTrainer, TrainerCollator
from dynapix.train.student.vision_cache import VisionCache

log = logging.getLogger(__name__)


def prefetch_factor(workers: int, accumulation: int) -> int | None:
    """Return the number of batches that each worker prepares in advance; None without workers.

    The trainer requests all micro-batches of an optimizer step at once. Together, the workers
    prepare at least as many in advance, so that they are ready when the previous step ends.
    """
    return max(2, math.ceil(accumulation / workers)) if workers else None


def student_arguments(
    train: StudentTrainConfig, run: Run, seed: int, checkpoint: Path | None, all_weights: bool
) -> TrainingArguments:
    """Return the arguments of a student's trainer.

    Args:
        train: The settings; `precision` is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.
        all_weights: Whether all weights are trained, not only adapters.
    """
    accumulation = split_batch(train.batch, train.micro_batch)
    return TrainingArguments(
        **common_arguments(train, run, seed, checkpoint),
        per_device_train_batch_size=train.micro_batch,
        gradient_accumulation_steps=accumulation,
        per_device_eval_batch_size=train.micro_batch,
        dataloader_prefetch_factor=prefetch_factor(train.workers, accumulation),
        label_names=["labels"],
        # Every pass uses all adapters. If all weights are trained, prompts without images leave
        # those of the vision tower unused.
        ddp_find_unused_parameters=all_weights,
    )


def build_trainer(
    cfg: SftCommand,
    run: Run,
    model: nn.Module,
    processor: ProcessorMixin,
    training: StudentDataset,
    validation: dict[str, StudentDataset],
    checkpoint: Path | None,
) -> StudentTrainer:
    """Audit the model and the longest sample, and return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: the model does not fit its preset, the longest sample is too long, or
            train.reuse_features is set and the vision tower is trained or sharded.
    """
    train, student = cfg.train, cfg.student
    collator = Collator(processor, student.max_length)
    lengths = training.lengths(processor, student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit_student(model, processor, student, longest, collator))
    sampler = LengthSampler(
        lengths,
        training.item_ids,
        train.batch,
        cfg.seed,
        train.micro_batch,
        world_size(),
        pairs=train.micro_batch > 1 and shares_prompts(model),
    )
    cache = answers = None
    if train.reuse_features and not takes_clips(processor):
        log.info("train.reuse_features has no effect: only features of Qwen models are reused")
    elif train.reuse_features:
        # The ranks of this machine together cache up to half of its free memory.
        limit = available_cpu_bytes() // 2 // local_world_size()
        cache = VisionCache(model, train.precision, limit)
    if train.generated_items:
        answers = HeldOutAnswers(train, student, processor, run.folder)
    return StudentTrainer(
        model=model,
        args=student_arguments(train, run, cfg.seed, checkpoint, not student.lora.rank),
        data_collator=TrainerCollator(collator, digests=cache is not None),
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=LOSSES[train.weighting],
        callbacks=[EpochCallback(training, sampler)],
        sampler=sampler,
        accuracy=LetterAccuracy(letter_ids(processor)),
        answers=answers,
        vision_cache=cache,
    )
