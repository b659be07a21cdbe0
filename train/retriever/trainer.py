"""Trainers of sentence-transformers whose batches are the numbers (indices) of queries.

The library's collator would load the pixels of a whole batch, and its sampler would put queries
with the same frames into one batch. Here `QueryBatchSampler` chooses the queries of a batch, and
the loss loads their pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from datasets import Dataset
from sentence_transformers import (
    MultiVectorEncoderTrainer,
    MultiVectorEncoderTrainingArguments,
    SentenceTransformerTrainer,
    SentenceTransformerTrainingArguments,
)
from sentence_transformers.sentence_transformer.data_collator import (
    SentenceTransformerDataCollator,
)

from dynapix.conf.errors import UserError
from dynapix.conf.runs import Run, world_size
from dynapix.conf.schema import ContrastiveCommand, ContrastiveTrainConfig, RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.data.store import Store
from dynapix.models.checks import ADAPTER_WEIGHTS
from dynapix.models.retriever.embedder import load_adapters, longest_query
from dynapix.models.retriever.inputs import QueryOrFrame, Retriever, query_form
from dynapix.train.common.audit import audit_retriever
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.common.training_loop import common_arguments
from dynapix.train.retriever.batches import QueryBatchSampler, batch_columns
from dynapix.train.retriever.evaluator import HeldOutEvaluator, build_database
from dynapix.train.retriever.inputs import RetrieverInputs
from dynapix.train.retriever.loss import RankingLoss

log = logging.getLogger(__name__)

NUMBER = "query"
"""Name of the only column of the training dataset: the number of a query."""


def numbered_rows(count: int) -> Dataset:
    """Return a training dataset for `count` queries. Each row has the number of a query."""
    return Dataset.from_dict({NUMBER: list(range(count))})


class IndexCollator(SentenceTransformerDataCollator):
    """Collates rows into a list of the numbers of their queries."""

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, list[int]]:
        return {"indices": [row[NUMBER] for row in rows]}


class IndexBatchTrainer:
    """Mixin that lets a trainer of the library take batches of query numbers.

    Args:
        sampler: Chooses the queries of each batch.
        columns_of: Turns the numbers of a batch's queries into the columns that the loss takes.
    """

    def __init__(
        self,
        *args: Any,
        sampler: QueryBatchSampler,
        columns_of: Callable[[Sequence[int]], list[list[QueryOrFrame]]],
        **options: Any,
    ) -> None:
        self._sampler = sampler
        self._columns_of = columns_of
        super().__init__(*args, **options)

    def add_model_card_callback(self, *_: Any) -> None:
        """Add no callback: its model card would show texts of the rows, which have numbers only."""

    def get_batch_sampler(self, *_: Any, **__: Any) -> QueryBatchSampler:
        return self._sampler

    def collect_features(
        self, inputs: dict[str, list[int]]
    ) -> tuple[list[list[QueryOrFrame]], None]:
        return self._columns_of(inputs["indices"]), None

    def _load_from_checkpoint(self, checkpoint_path: str) -> None:
        """Load only the adapters and the head, if adapters are trained. The library would load the
        base too, without quantisation, and its weights would not fit the quantised model."""
        folder = Path(checkpoint_path)
        if (folder / ADAPTER_WEIGHTS).exists():
            load_adapters(self.model, folder)
        else:
            super()._load_from_checkpoint(checkpoint_path)


class RetrieverTrainer(IndexBatchTrainer, SentenceTransformerTrainer):
    """Trains a retriever with one vector per input."""


class MultiVectorTrainer(IndexBatchTrainer, MultiVectorEncoderTrainer):
    """Trains a retriever with many vectors per input."""


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
        scale=train.scale,
        mini_batch=train.mini_batch,
        prefetch=train.workers,
    )
