"""Train a student on rationales or answers: LoRA over a frozen, quantised base."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.runs import finished
from conf.schema import SftCommand

log = logging.getLogger(__name__)


@command("train.sft", SftCommand)
def main(cfg: SftCommand, run: Run) -> dict[str, float]:
    if (metrics := finished(run)) is not None:
        log.info("%s is finished; delete it, or give run=NAME, to train anew", run.folder)
        return metrics

    from data.build import ensure_benchmark
    from teacher.narrate import ensure_rationales

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    rationales = []
    if cfg.train.regime != "answer_only":
        rationales = ensure_rationales(store, cfg.teacher)

    from transformers import TrainingArguments, set_seed

    from data.frames import Frames
    from train import backbone, loop, memory, samples
    from train.audit import audit
    from train.collate import Collator, letter_ids
    from train.features import Features, Keyed
    from train.planned import ByLength
    from train.sft_trainer import Epochs, LetterChoice, StudentTrainer, TokenChoice, token_mean

    backbone.keep_big_blocks()
    loop.keep_to_one_gpu()
    # Adapters are drawn before the trainer sets its seed.
    set_seed(cfg.seed)
    log.info("loading student %s", cfg.student.name)
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
    collator = Collator(processor, cfg.student.max_length)
    lengths = training.lengths(processor.tokenizer, cfg.student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit(model, processor, cfg.student, longest, collator))
    train = memory.settle(cfg.train, run.folder, model, collator, training, lengths)
    order = ByLength(lengths, train.batch, cfg.seed)
    features = Features.of(model, train) if train.reuse_features else None

    # Descriptions end in no answer whose letter could be measured.
    describes = cfg.train.regime == "describe"
    choice = TokenChoice() if describes else LetterChoice(letter_ids(processor))
    checkpoint = loop.newest_checkpoint(run.folder)
    trainer = StudentTrainer(
        model=model,
        args=TrainingArguments(
            **loop.arguments(train, run, cfg.seed, checkpoint),
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=train.batch // train.micro_batch,
            per_device_eval_batch_size=train.micro_batch,
            dataloader_prefetch_factor=loop.prefetched(
                train.workers, train.batch // train.micro_batch
            ),
            label_names=["labels"],
        ),
        data_collator=Keyed(collator) if features else collator.named,
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=token_mean,
        callbacks=[Epochs(training, order)],
        order=order,
        choice=choice,
        features=features,
    )
    loop.train_and_log(trainer, run, checkpoint, memory.lower(train))
    backbone.save(model, processor, run.folder / "student", cfg.train.precision)
    log.info("the student is in %s", run.folder / "student")
    return loop.evaluated(run.folder)


if __name__ == "__main__":
    main()
