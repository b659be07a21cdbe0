"""Train a retriever: Matryoshka over cached multiple-negatives ranking."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import finished
from conf.schema import ContrastiveCommand
from conf.trackers import check_trackers

log = logging.getLogger(__name__)


@command("train.contrastive", ContrastiveCommand)
def main(cfg: ContrastiveCommand, run: Run) -> dict[str, float]:
    if (metrics := finished(run)) is not None:
        log.info("%s is finished; delete it, or give run=NAME, to train anew", run.folder)
        return metrics

    check_trackers(cfg.train.report_to)

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from datasets import Dataset
    from sentence_transformers import (
        SentenceTransformerTrainer,
        SentenceTransformerTrainingArguments,
    )
    from sentence_transformers.base.sampler import BatchSamplers
    from sentence_transformers.sentence_transformer.losses import (
        CachedMultipleNegativesRankingLoss,
        MatryoshkaLoss,
    )
    from transformers import set_seed

    from data.frames import Frames
    from train import checkpoints, compatible, loop, retriever, room
    from train.audit import audit_retriever
    from train.ranking import HeldOutRanking
    from train.samples import held_out_scenes, shuffled

    room.keep_big_blocks()
    loop.keep_to_one_gpu()
    # Adapters are drawn before the trainer sets its seed.
    set_seed(cfg.seed)
    frames = Frames(store, cfg.retriever.image_size)
    queries = store.retrieval("train")
    held_out = held_out_scenes(store)
    training = [q for q in queries if q.scene_id not in held_out]
    # Queries stand builder by builder: a shuffled slice measures all of them.
    validation = shuffled([q for q in queries if q.scene_id in held_out], cfg.seed)
    validation = validation[: cfg.train.validation_queries]
    loop.check_not_empty(len(training), "training queries")
    loop.check_not_empty(len(validation), "queries of held-out training scenes")
    if len(training) < cfg.train.batch:
        raise UserError(
            f"train.batch={cfg.train.batch} is more than the {len(training)} training queries of "
            f"{store.folder}: lower it"
        )

    log.info("loading retriever %s", cfg.retriever.name)
    compatible.note_base(run.folder, cfg.retriever.model)
    model = retriever.load_retriever(
        cfg.retriever,
        cfg.train.precision,
        corpus=retriever.corpus(queries, cfg.retriever),
        folder=run.folder / "untrained",
    )
    longest = retriever.longest_query(training, model.tokenizer)
    log.info(audit_retriever(model, cfg.retriever, longest, frames))
    ranking = HeldOutRanking(validation, frames, cfg.retriever, cfg.train.mini_batch)
    loss = MatryoshkaLoss(
        model,
        CachedMultipleNegativesRankingLoss(
            model, scale=cfg.train.scale, mini_batch_size=cfg.train.mini_batch
        ),
        matryoshka_dims=list(cfg.retriever.widths),
    )
    rows = [retriever.row(q, cfg.train.hard_negatives) for q in training]
    collator = retriever.LateFrames(
        preprocess_fn=model.preprocess, prompts=retriever.column_prompts(cfg.retriever, rows[0])
    )
    collator.resolve(training, frames, cfg.retriever)
    checkpoint = checkpoints.newest_checkpoint(run.folder)
    trainer = SentenceTransformerTrainer(
        model=model,
        args=SentenceTransformerTrainingArguments(
            **loop.arguments(cfg.train, run, cfg.seed, checkpoint),
            per_device_train_batch_size=cfg.train.batch,
            dataloader_drop_last=True,
            # A frame that two rows name would be a negative of itself.
            batch_sampler=BatchSamplers.NO_DUPLICATES,
        ),
        train_dataset=Dataset.from_list(rows),
        evaluator=ranking,
        loss=loss,
        data_collator=collator,
    )
    best = loop.train_and_log(
        trainer, run, checkpoint, "train.mini_batch, which changes no gradient"
    )
    model.save_pretrained(str(run.folder / "retriever"), create_model_card=False)
    log.info("the retriever is in %s", run.folder / "retriever")
    return loop.evaluated(run.folder, best)


if __name__ == "__main__":
    main()
