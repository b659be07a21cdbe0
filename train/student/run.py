"""A student's training, from its base to the weights that are written."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState
from torch import nn
from transformers import ProcessorMixin, TrainingArguments, set_seed

from conf.entry import Run
from conf.errors import UserError
from conf.runs import rank
from conf.schema import SftCommand, SftTrainConfig
from data.records import Rationale
from data.render.frame_cache import FrameReader
from data.store import Store
from models import checks, distributed, loading, memory
from models.lora_kernels import fuse
from models.resolved import data_digest, resolve_run
from models.student.collator import Collator, letter_ids
from train.common import checkpoints, journal, memory_probe, training_loop
from train.common.audit import audit
from train.student import dataset
from train.student.held_out_answers import HeldOutAnswers
from train.student.lazy_samples import LengthSampler, Samples
from train.student.packing import PackingCollator, rope_of
from train.student.trainer import LetterChoice, StudentTrainer, TokenChoice, token_mean
from train.student.vision_cache import Features, Keyed
from train.tiny_base.object_tokens import ObjectTokenCollator, ObjectTokenTrainer, scene_word_tokens

log = logging.getLogger(__name__)


def train_student(
    cfg: SftCommand, run: Run, store: Store, rationales: list[Rationale]
) -> dict[str, float]:
    """Train a student in its run's folder and give what it measured there."""
    memory.keep_freed_memory()
    # Adapters are drawn before the trainer sets its seed.
    set_seed(cfg.seed)
    training, validation = split(cfg, store, rationales)
    data = data_digest(store.identity, training.texts)
    with distributed.main_first():
        precision, student = resolve_run(run.folder, cfg.train.precision, cfg.student, data)
    cfg = replace(cfg, student=student, train=replace(cfg.train, precision=precision))
    log.info("loading student %s, to compute in %s", cfg.student.name, cfg.train.precision)
    with training_loop.loading(run.folder, "student"):
        model, processor = loading.load_student(
            cfg.student, cfg.train.precision, lambda: dataset.corpus(store, rationales)
        )
        if not distributed.is_sharded():
            # Else the trainer would only find later that it does not fit.
            model.to(PartialState(cpu=not torch.cuda.is_available()).device)
    fuse(model)
    ways = ways_of(cfg, model, processor)
    lengths = training.lengths(processor.tokenizer, cfg.student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit(model, processor, cfg.student, longest, ways.collator))
    train = memory_probe.settle(cfg.train, run.folder, model, ways.packs, training, lengths)
    order = LengthSampler(lengths, train.batch, cfg.seed, train.micro_batch, distributed.ranks())
    checkpoint = checkpoints.newest_checkpoint(run.folder)
    if checkpoint is not None:
        checks.check_adapters(checkpoint, model, cfg.student)

    if train.reuse_features and distributed.is_sharded():
        raise UserError(
            "train.reuse_features=true cannot be had with FSDP, which leaves no rank a whole "
            "vision tower: leave one of the two away"
        )
    features = Features.of(model, train) if train.reuse_features else None
    made = Keyed if features else attrgetter("named")
    trainer = ways.trainer(
        model=model,
        args=arguments(train, run, cfg, checkpoint),
        data_collator=made(ways.collator),
        training_collator=made(ways.packs),
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=token_mean,
        callbacks=[training_loop.Epochs(training, order)],
        order=order,
        choice=ways.choice,
        features=features,
        answers=answers(cfg, processor, run.folder),
    )
    best = training_loop.train_and_log(trainer, run, checkpoint, memory_probe.lower(train))
    weights = training_loop.gathered(trainer)
    if rank() == 0:
        # A base for others is written as bases are released, whatever it was computed in.
        written = "bf16" if cfg.train.regime == "describe" else cfg.train.precision
        loading.save_student(model, processor, run.folder / "student", written, weights)
    log.info("the student is in %s", run.folder / "student")
    return journal.evaluated(run.folder, best)


def split(
    cfg: SftCommand, store: Store, rationales: list[Rationale]
) -> tuple[Samples, dict[str, Samples]]:
    """The samples trained on, and those of held-out scenes by mode.

    Raises:
        UserError: there are none.
    """
    if cfg.train.regime not in ("answer_only", "describe"):
        training_loop.check_not_empty(
            len(rationales), f"accepted rationales of teacher {cfg.teacher.name}"
        )
    frames = FrameReader(store, cfg.student.image_size)
    training, validation = dataset.splits(store, rationales, cfg, frames)
    training_loop.check_not_empty(len(training), f"samples for train.regime={cfg.train.regime}")
    training_loop.check_not_empty(
        sum(map(len, validation.values())), "items of held-out training scenes"
    )
    return training, validation


@dataclass(frozen=True)
class Ways:
    """How samples of a regime become batches, packed ones (`packs`) where the attention takes them,
    and what is learnt and measured on them."""

    collator: Collator
    packs: Collator | PackingCollator
    choice: TokenChoice | LetterChoice
    trainer: Callable[..., StudentTrainer]


def ways_of(cfg: SftCommand, model: nn.Module, processor: ProcessorMixin) -> Ways:
    if cfg.train.regime == "describe":
        # Descriptions end in no answer whose letter could be measured, and teach to see.
        collator = ObjectTokenCollator(processor, cfg.student.max_length)
        return Ways(
            collator, collator, TokenChoice(scene_word_tokens(processor)), ObjectTokenTrainer
        )
    collator = Collator(processor, cfg.student.max_length)
    rope = rope_of(model, cfg.train.packing)
    packs = PackingCollator(processor, cfg.student.max_length, rope) if rope else collator
    return Ways(collator, packs, LetterChoice(letter_ids(processor)), StudentTrainer)


def arguments(
    train: SftTrainConfig, run: Run, cfg: SftCommand, checkpoint: Path | None
) -> TrainingArguments:
    accumulation = distributed.accumulation_steps(train.batch, train.micro_batch)
    shared: dict[str, Any] = training_loop.arguments(train, run, cfg.seed, checkpoint)
    return TrainingArguments(
        **shared,
        per_device_train_batch_size=train.micro_batch,
        gradient_accumulation_steps=accumulation,
        per_device_eval_batch_size=train.micro_batch,
        dataloader_prefetch_factor=training_loop.prefetched(train.workers, accumulation),
        label_names=["labels"],
        # Every pass goes through all adapters; a whole model's tower has nothing to do where no
        # frames are shown.
        ddp_find_unused_parameters=not cfg.student.lora.rank,
    )


def answers(cfg: SftCommand, processor: ProcessorMixin, folder: Path) -> HeldOutAnswers | None:
    """What is asked of the student at each evaluation; None where the settings ask nothing."""
    count = cfg.train.generated_items
    if not count:
        return None
    return HeldOutAnswers(processor, cfg.student, cfg.train.precision, count, folder)
