"""sentence-transformers' trainers on batches of query numbers.

The library's collator loads everything that a batch shows, and its sampler knows no scenes. Here a
batch holds the numbers of its queries, and the loss loads their pixels.
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

from models.retriever.embedder import ADAPTERS, load_adapters
from train.retriever.batches import QueryBatchSampler

NUMBER = "query"
"""The column of a training row: the number of its query."""


def numbered_rows(count: int) -> Dataset:
    """Training rows that name queries by number."""
    return Dataset.from_list([{NUMBER: k} for k in range(count)])


class IndexCollator(SentenceTransformerDataCollator):
    """Collates rows to the numbers of their queries."""

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, list[int]]:
        return {"indices": [row[NUMBER] for row in rows]}


class IndexBatchTrainer:
    """Mixin for the library's trainers.

    Args:
        sampler: Composes the batches of an epoch.
        columns_of: The loss's features for the numbers of a batch's queries.
    """

    def __init__(
        self,
        *args: Any,
        sampler: QueryBatchSampler,
        columns_of: Callable[[Sequence[int]], list[dict[str, Any]]],
        **options: Any,
    ) -> None:
        self._sampler = sampler
        self._columns_of = columns_of
        super().__init__(*args, **options)

    def add_model_card_callback(self, *_: Any) -> None:
        """A card's examples come from texts in the training rows, which only hold numbers."""

    def get_batch_sampler(self, *_: Any, **__: Any) -> QueryBatchSampler:
        return self._sampler

    def collect_features(self, inputs: dict[str, list[int]]) -> tuple[list[dict[str, Any]], None]:
        return self._columns_of(inputs["indices"]), None

    def _load_from_checkpoint(self, checkpoint_path: str) -> None:
        """Load adapters into the present ones: the library would load the base again without
        quantisation, and fail because the weights do not fit."""
        folder = Path(checkpoint_path)
        if (folder / ADAPTERS).exists():
            load_adapters(self.model, folder)
        else:
            super()._load_from_checkpoint(checkpoint_path)

    def _load_best_model(self) -> None:
        """Where this fails, the library would log it and keep the last weights."""
        self._load_from_checkpoint(self.state.best_model_checkpoint)


class RetrieverTrainer(IndexBatchTrainer, SentenceTransformerTrainer):
    """For a retriever with one vector."""


class MultiVectorTrainer(IndexBatchTrainer, MultiVectorEncoderTrainer):
    """For a retriever with many vectors."""
