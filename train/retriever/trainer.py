"""sentence-transformers' trainers on batches of query numbers.

The library's collator would load the pixels of a whole batch, and its sampler would put queries
with the same frames into one batch. Here a batch holds the numbers of queries that
`QueryBatchSampler` chose, and the loss loads their pixels.
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

from models.retriever.embedder import ADAPTERS, Item, load_adapters
from train.retriever.batches import QueryBatchSampler

NUMBER = "query"
"""The column of a training row: the number of its query."""


def numbered_rows(count: int) -> Dataset:
    """Return a training row for each query, with its number."""
    return Dataset.from_dict({NUMBER: list(range(count))})


class IndexCollator(SentenceTransformerDataCollator):
    """Collates rows to the numbers of their queries."""

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, list[int]]:
        return {"indices": [row[NUMBER] for row in rows]}


class IndexBatchTrainer:
    """Mixin for the library's trainers.

    Args:
        sampler: Chooses the queries of each batch.
        columns_of: Returns the columns of a batch, which the loss takes, from the numbers of its
            queries.
    """

    def __init__(
        self,
        *args: Any,
        sampler: QueryBatchSampler,
        columns_of: Callable[[Sequence[int]], list[list[Item]]],
        **options: Any,
    ) -> None:
        self._sampler = sampler
        self._columns_of = columns_of
        super().__init__(*args, **options)

    def add_model_card_callback(self, *_: Any) -> None:
        """Add no callback: its card would show texts of the rows, which only hold numbers."""

    def get_batch_sampler(self, *_: Any, **__: Any) -> QueryBatchSampler:
        return self._sampler

    def collect_features(self, inputs: dict[str, list[int]]) -> tuple[list[list[Item]], None]:
        return self._columns_of(inputs["indices"]), None

    def _load_from_checkpoint(self, checkpoint_path: str) -> None:
        """Load the weights of the adapters only: the library would load the base again, without
        quantisation, and its weights would not fit."""
        folder = Path(checkpoint_path)
        if (folder / ADAPTERS).exists():
            load_adapters(self.model, folder)
        else:
            super()._load_from_checkpoint(checkpoint_path)

    def _load_best_model(self) -> None:
        """Load the best weights or fail: the library would only log an error and keep the last
        weights."""
        self._load_from_checkpoint(self.state.best_model_checkpoint)


class RetrieverTrainer(IndexBatchTrainer, SentenceTransformerTrainer):
    """For a retriever with one vector."""


class MultiVectorTrainer(IndexBatchTrainer, MultiVectorEncoderTrainer):
    """For a retriever with many vectors."""
