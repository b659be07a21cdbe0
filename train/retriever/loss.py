"""The retriever's losses: the library's cached ranking losses over batches that hold names.

The library embeds a batch twice, first to cache the gradients of the embeddings, then to propagate
them, and cuts mini-batches from inputs that are all in memory. Here the inputs of a mini-batch are
loaded when a pass reaches it. A frame that is some query's target is never a negative of that
query.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import Any, TypeVar

import torch
from accelerate.utils import gather_object
from sentence_transformers.base.losses.gradcache import RandContext
from sentence_transformers.multi_vector_encoder.losses import (
    CachedMultiVectorMultipleNegativesRankingLoss,
)
from sentence_transformers.multi_vector_encoder.scoring import colbert_scores
from sentence_transformers.sentence_transformer.losses import CachedMultipleNegativesRankingLoss
from sentence_transformers.util import cos_sim

from conf.runs import rank, world_size
from data.records import FrameRef
from models.nonfinite_guard import check_finite
from models.retriever.embedder import Retriever, item_name
from train.retriever.inputs import RetrieverInputs

In = TypeVar("In")
Out = TypeVar("Out")


class LazyBatchLoss:
    """Mixin for the library's cached losses: features name `items`, as `batch_columns` makes them.

    Args:
        model: The retriever.
        inputs: Loads the inputs of a mini-batch.
        scale: Inverse temperature of the scores.
        mini_batch: Queries or frames in a mini-batch; the gradients are independent of it.
        prefetch: Mini-batches that a thread loads ahead.
    """

    similarity: Callable[..., torch.Tensor]
    query_major = False
    """Whether scores order documents by their query; otherwise by column."""

    def __init__(
        self,
        model: Retriever,
        inputs: RetrieverInputs,
        *,
        scale: float,
        mini_batch: int,
        prefetch: int = 0,
    ) -> None:
        super().__init__(
            model,
            scale=scale,
            similarity_fct=self._scores,
            mini_batch_size=mini_batch,
            gather_across_devices=world_size() > 1,
        )
        self._inputs = inputs
        self._prefetch = prefetch

    def forward(
        self, sentence_features: Iterable[dict[str, Any]], labels: torch.Tensor | None = None
    ) -> torch.Tensor:
        features = list(sentence_features)
        documents = [column["items"] for column in features[1:]]
        parts = gather_object([documents]) if world_size() > 1 else [documents]
        columns = [list(chain(*column)) for column in zip(*parts, strict=True)]
        rows = len(documents[0])
        own = range(rank() * rows, (rank() + 1) * rows)
        self._identical = identical_frames(columns, own, self.query_major)
        self._next_row = 0
        return super().forward(features, labels)

    def embed_minibatch_iter(
        self,
        sentence_feature: dict[str, Any],
        with_grad: bool,
        copy_random_state: bool,
        random_states: list[RandContext] | None = None,
        ranges: Sequence[tuple[int, int]] = (),
    ) -> Iterator[tuple[Any, ...]]:
        """Embed the items of each range, as the library does of inputs in memory.

        Raises:
            UserError: An embedding is not finite.
        """
        parts = [sentence_feature["items"][first:last] for first, last in ranges]
        task = {name: sentence_feature[name] for name in ("task",) if name in sentence_feature}
        for k, loaded in enumerate(prefetched(self._inputs.load, parts, self._prefetch)):
            inputs = self._inputs.prepare(parts[k], loaded, first_pass=not with_grad)
            state = None if random_states is None else random_states[k]
            embedded = self.embed_minibatch(
                inputs | task, 0, len(parts[k]), with_grad, copy_random_state, state
            )
            if not with_grad:
                check_finite(embedded[0], lambda k=k: [item_name(item) for item in parts[k]])
            yield embedded

    def _scores(self, queries: torch.Tensor, documents: torch.Tensor, **masks: Any) -> torch.Tensor:
        """Similarities of the next rows of queries with all documents. The library asks for all
        rows in their order, once for each width."""
        scores = type(self).similarity(queries, documents, **masks)
        rows = slice(self._next_row, self._next_row + len(queries))
        self._next_row = rows.stop % len(self._identical)
        return scores.masked_fill(self._identical[rows].to(scores.device), -torch.inf)


class RankingLoss(LazyBatchLoss, CachedMultipleNegativesRankingLoss):
    """For a retriever with one vector."""

    similarity = staticmethod(cos_sim)


class MultiVectorRankingLoss(LazyBatchLoss, CachedMultiVectorMultipleNegativesRankingLoss):
    """For a retriever with many vectors, by late interaction."""

    similarity = staticmethod(colbert_scores)
    query_major = True


def identical_frames(
    columns: Sequence[Sequence[FrameRef]], own: range, query_major: bool
) -> torch.Tensor:
    """(own, documents) where a document is the frame of a query's target but not its target.

    Args:
        columns: The targets of all ranks' queries, then their hard negatives by column.
        own: Positions of the queries of this rank.
        query_major: Whether documents are ordered by their query; otherwise by column.
    """
    codes: dict[FrameRef, int] = {}
    table = torch.tensor([[codes.setdefault(f, len(codes)) for f in column] for column in columns])
    identical = table[0, list(own), None, None] == table
    identical[range(len(own)), 0, list(own)] = False
    return (identical.transpose(1, 2) if query_major else identical).flatten(1)


def prefetched(load: Callable[[In], Out], items: Sequence[In], ahead: int) -> Iterator[Out]:
    """`load(item)` of each item in order, up to `ahead` before they are consumed. A single thread
    loads them: several must not share a tokenizer."""
    if not ahead:
        yield from map(load, items)
        return
    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(load, item) for item in items[: ahead + 1]]
        for k in range(len(items)):
            loaded = waiting.pop(0).result()
            if k + ahead + 1 < len(items):
                waiting.append(pool.submit(load, items[k + ahead + 1]))
            yield loaded
