"""Trainers of sentence-transformers whose batches are the numbers (indices) of queries.

The library's collator would load the pixels of a whole batch, and its sampler would put queries
with the same frames into one batch. Here `QueryBatchSampler` chooses the queries of a batch, and
the loss loads their pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from datasets import Dataset
from sentence_transformers import MultiVectorEncoderTrainer, SentenceTransformerTrainer
from sentence_transformers.sentence_transformer.data_collator import (
    SentenceTransformerDataCollator,
)

from dynapix.models.checks import ADAPTER_WEIGHTS
from dynapix.models.retriever.embedder import load_adapters
from dynapix.models.retriever.inputs import QueryOrFrame
from dynapix.train.retriever.batches import QueryBatchSampler

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
