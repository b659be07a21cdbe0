"""Build a retriever's trainer from its settings."""

from __future__ import annotations

import logging
from pathlib import Path

from sentence_transformers import (
    MultiVectorEncoderTrainingArguments,
    SentenceTransformerTrainingArguments,
)

from dynapix.conf.errors import UserError
from dynapix.conf.runs import Run, world_size
from dynapix.conf.schema import ContrastiveCommand, ContrastiveTrainConfig, RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.data.store import Store
from dynapix.models.retriever.embedder import longest_query
from dynapix.models.retriever.inputs import Retriever, query_form
from dynapix.train.common.arguments import common_arguments
from dynapix.train.common.audit import audit_retriever
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.retriever.batches import QueryBatchSampler, batch_columns
from dynapix.train.retriever.evaluator import HeldOutEvaluator, build_database
from dynapix.train.retriever.inputs import RetrieverInputs
from dynapix.train.retriever.loss import RankingLoss
from dynapix.train.retriever.trainer import (
    IndexCollator,
    MultiVectorTrainer,
    RetrieverTrainer,
    numbered_rows,
)

log = logging.getLogger(__name__)


def build_trainer(
    cfg: ContrastiveCommand,
    run: Run,
    store: Store,
    model: Retriever,
    training: list[RetrievalQuery],
    validation: list[RetrievalQuery],
    rank_batch: int,
    checkpoint: Path | None,
) -> RetrieverTrainer | MultiVectorTrainer:
    """Audit the model and the longest query, and return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        rank_batch: Queries per step and rank.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: the model does not fit its preset or several ranks, or the longest query is too
            long.
    """
    train, retriever = cfg.train, cfg.retriever
    if world_size() > 1 and query_form(model, retriever) == "separate":
        # DDP allows one forward pass before a backward pass.
        raise UserError(
            f"{retriever.name} embeds frames and questions separately, which only one rank can "
            "train: start train.contrastive without a launcher",
            code="unsupported-ranks",
        )
    frames = FrameReader(store, retriever.image_size)
    log.info(audit_retriever(model, retriever, longest_query(training, model.tokenizer), frames))
    negatives = train.hard_negatives
    sampler = QueryBatchSampler(training, negatives, train.batch, cfg.seed, world_size())
    # The dataset has only query numbers: the loss itself loads the pixels, without workers.
    common = common_arguments(train, run, cfg.seed, checkpoint) | {"dataloader_num_workers": 0}
    if retriever.late is None:
        trainer_type, arguments = RetrieverTrainer, SentenceTransformerTrainingArguments
    else:
        trainer_type, arguments = MultiVectorTrainer, MultiVectorEncoderTrainingArguments
    return trainer_type(
        model=model,
        args=arguments(**common, per_device_train_batch_size=rank_batch, dataloader_drop_last=True),
        train_dataset=numbered_rows(len(training)),
        evaluator=HeldOutEvaluator(
            validation, build_database(validation, store), frames, retriever, train.mini_batch
        ),
        loss=build_loss(train, retriever, model, frames),
        data_collator=IndexCollator(preprocess_fn=model.preprocess),
        callbacks=[EpochCallback(sampler)],
        sampler=sampler,
        columns_of=lambda numbers: batch_columns([training[k] for k in numbers], negatives),
    )


def build_loss(
    train: ContrastiveTrainConfig,
    retriever: RetrieverConfig,
    model: Retriever,
    frames: FrameReader,
) -> RankingLoss:
    """Return the ranking loss. A retriever with many vectors per input has a single width."""
    bf16 = train.precision == "bf16"
    return RankingLoss(
        model,
        RetrieverInputs(model, frames, retriever, bf16, train.reuse_features),
        widths=retriever.widths if retriever.late is None else [retriever.late.width],
        weights=train.width_weights,
        scale=train.scale,
        mini_batch=train.mini_batch,
        prefetch=train.workers,
    )
