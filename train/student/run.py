"""Build a student's datasets and trainer from its settings."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from torch import nn
from transformers import ProcessorMixin, TrainingArguments

from conf.runs import Run, local_world_size, world_size
from conf.schema import SftCommand
from data.records import Rationale
from data.render.frame_cache import FrameReader
from data.store import Store
from models.checks import check_adapters
from models.memory import available_cpu_bytes
from train.common.arguments import common_arguments, prefetch_factor
from train.common.audit import audit
from train.common.callbacks import EpochCallback
from train.student.dataset import build_datasets
from train.student.held_out_answers import HeldOutAnswers
from train.student.lazy_samples import StudentDataset
from train.student.length_sampler import LengthSampler
from train.student.regimes import TrainerCollator, regime_components
from train.student.trainer import StudentTrainer, token_mean
from train.student.vision_cache import VisionCache

log = logging.getLogger(__name__)


def load_datasets(
    cfg: SftCommand, store: Store, rationales: list[Rationale]
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return the training dataset, and the held-out datasets by mode; both render on demand.

    Raises:
        UserError: a dataset is empty.
    """
    return build_datasets(
        store,
        rationales,
        FrameReader(store, cfg.student.image_size),
        regime=cfg.train.regime,
        frame_count=cfg.student.frames,
        seed=cfg.seed,
        validation_items=cfg.train.validation_items,
        permute_candidates=cfg.train.permute_candidates,
    )


def build_trainer(
    cfg: SftCommand,
    run: Run,
    model: nn.Module,
    processor: ProcessorMixin,
    training: StudentDataset,
    validation: dict[str, StudentDataset],
    accumulation: int,
    checkpoint: Path | None,
) -> StudentTrainer:
    """Audit the model and the longest sample, and return a trainer for the regime.

    Args:
        cfg: Settings with a resolved precision.
        accumulation: Micro-batches of a step on each rank.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: the model is not what its preset says, the longest sample is too long, or the
            checkpoint's adapters do not fit.
    """
    train, student = cfg.train, cfg.student
    parts = regime_components(train.regime, model, processor, student.max_length, train.packing)
    lengths = training.lengths(processor.tokenizer, student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit(model, processor, student, longest, parts.collator))
    if checkpoint is not None:
        check_adapters(checkpoint, model, student.lora.rank, student.model)

    cache = None
    if train.reuse_features:
        # Half of the free memory, shared by the ranks of this machine.
        cache = VisionCache(
            model, train.precision, available_cpu_bytes() // 2 // local_world_size()
        )
    answers = None
    if train.generated_items:
        answers = HeldOutAnswers(
            processor,
            run.folder,
            max_length=student.max_length,
            max_new_tokens=student.max_new_tokens,
            precision=train.precision,
            count=train.generated_items,
        )
    sampler = LengthSampler(lengths, train.batch, cfg.seed, train.micro_batch, world_size())
    common: dict[str, Any] = common_arguments(train, run, cfg.seed, checkpoint)
    arguments = TrainingArguments(
        **common,
        per_device_train_batch_size=train.micro_batch,
        gradient_accumulation_steps=accumulation,
        per_device_eval_batch_size=train.micro_batch,
        dataloader_prefetch_factor=prefetch_factor(train.workers, accumulation),
        label_names=["labels"],
        # Every pass uses all adapters; the vision tower of a whole model is unused in prompts
        # without images.
        ddp_find_unused_parameters=not student.lora.rank,
    )
    return parts.trainer(
        model=model,
        args=arguments,
        data_collator=TrainerCollator(parts.collator, digests=cache is not None),
        training_collator=TrainerCollator(parts.training_collator, digests=cache is not None),
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=token_mean,
        callbacks=[EpochCallback(training, sampler)],
        sampler=sampler,
        accuracy=parts.accuracy,
        answers=answers,
        vision_cache=cache,
    )
