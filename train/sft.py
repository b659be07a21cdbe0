"""Train a student on rationales or answers: LoRA over a frozen, quantised base."""

from __future__ import annotations

import logging
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.runs import finished, rank
from conf.schema import SftCommand
from conf.trackers import check_trackers

if TYPE_CHECKING:
    from data.records import Rationale
    from data.store import Store

log = logging.getLogger(__name__)


@command("train.sft", SftCommand)
def main(cfg: SftCommand, run: Run) -> dict[str, float]:
    if (metrics := finished(run)) is not None:
        log.info("%s is finished; delete it, or give run=NAME, to train anew", run.folder)
        return metrics

    check_trackers(cfg.train.report_to)

    from train import ranks

    smallest = 1 if cfg.train.micro_batch == "auto" else cfg.train.micro_batch
    ranks.accumulation(cfg.train.batch, smallest)
    store, rationales = ranks.from_main(partial(prepared, cfg))

    from transformers import TrainingArguments, set_seed

    from data.frames import Frames
    from train import backbone, checkpoints, loop, memory, samples
    from train.audit import audit
    from train.collate import Collator, letter_ids
    from train.features import Features, Keyed
    from train.generate import HeldOutAnswers
    from train.packing import PackingCollator, rope_of
    from train.planned import ByLength
    from train.sft_trainer import Epochs, LetterChoice, StudentTrainer, TokenChoice, token_mean
    from train.sights import SightCollator, SightTrainer, seen_words

    backbone.keep_big_blocks()
    loop.keep_to_one_gpu()
    # Adapters are drawn before the trainer sets its seed.
    set_seed(cfg.seed)
    log.info("loading student %s", cfg.student.name)
    if rank() == 0:
        backbone.note_base(run.folder, cfg.student.model)
    model, processor = backbone.load_student(
        cfg.student, cfg.train.precision, lambda: samples.corpus(store, rationales)
    )
    frames = Frames(store, cfg.student.image_size)
    if cfg.train.regime not in ("answer_only", "describe"):
        loop.check_not_empty(len(rationales), f"accepted rationales of teacher {cfg.teacher.name}")
    training, validation = samples.splits(store, rationales, cfg, frames)
    loop.check_not_empty(len(training), f"samples for train.regime={cfg.train.regime}")
    loop.check_not_empty(sum(map(len, validation.values())), "items of held-out training scenes")
    # Descriptions end in no answer whose letter could be measured, and teach to see.
    describes = cfg.train.regime == "describe"
    letters = None if describes else LetterChoice(letter_ids(processor))
    choice = letters or TokenChoice(seen_words(processor))
    collator = (SightCollator if describes else Collator)(processor, cfg.student.max_length)
    rope = None if describes else rope_of(model, cfg.train.packing)
    packs = rope and PackingCollator(processor, cfg.student.max_length, rope)
    lengths = training.lengths(processor.tokenizer, cfg.student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit(model, processor, cfg.student, longest, collator))
    train = memory.settle(cfg.train, run.folder, model, packs or collator, training, lengths)
    accumulation = ranks.accumulation(train.batch, train.micro_batch)
    order = ByLength(lengths, train.batch, cfg.seed, train.micro_batch, ranks.ranks())
    features = Features.of(model, train) if train.reuse_features else None
    made = Keyed if features else attrgetter("named")

    answers = None
    if cfg.train.generated_items:
        asked = processor, cfg.student, cfg.train.precision, cfg.train.generated_items
        answers = HeldOutAnswers(*asked, run.folder)
    checkpoint = checkpoints.newest_checkpoint(run.folder)
    if checkpoint is not None:
        backbone.check_adapters(checkpoint, model, cfg.student)
    trainer = (SightTrainer if describes else StudentTrainer)(
        model=model,
        args=TrainingArguments(
            **loop.arguments(train, run, cfg.seed, checkpoint),
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=accumulation,
            per_device_eval_batch_size=train.micro_batch,
            dataloader_prefetch_factor=loop.prefetched(train.workers, accumulation),
            label_names=["labels"],
            # Every pass goes through all adapters; a whole model's tower has nothing to do where
            # no frames are shown.
            ddp_find_unused_parameters=not cfg.student.lora.rank,
        ),
        data_collator=made(collator),
        training_collator=made(packs or collator),
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=token_mean,
        callbacks=[Epochs(training, order)],
        order=order,
        choice=choice,
        features=features,
        answers=answers,
    )
    best = loop.train_and_log(trainer, run, checkpoint, memory.lower(train))
    weights = loop.gathered(trainer)
    if rank() == 0:
        backbone.save(model, processor, run.folder / "student", cfg.train.precision, weights)
    log.info("the student is in %s", run.folder / "student")
    return loop.evaluated(run.folder, best)


def prepared(cfg: SftCommand) -> tuple[Store, list[Rationale]]:
    """The benchmark, and the rationales where the regime has any, made where they are missing."""
    from data.build import ensure_benchmark
    from teacher.narrate import ensure_rationales

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    told = cfg.train.regime != "answer_only"
    return store, ensure_rationales(store, cfg.teacher) if told else []


if __name__ == "__main__":
    main()
