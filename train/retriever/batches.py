"""Choose the queries that train and evaluate a retriever, and compose batches of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from sentence_transformers.base.sampler import DefaultBatchSampler

from dynapix.conf.errors import UserError
from dynapix.conf.schema import ContrastiveTrainConfig
from dynapix.data.checks.queries import check_training, read_queries
from dynapix.data.records import FrameRef, RetrievalQuery
from dynapix.data.store import Store
from dynapix.train.common.held_out import check_not_empty, held_out_scenes, shuffled


def read_pools(store: Store, pools: Sequence[str]) -> list[RetrievalQuery]:
    """Return the queries of the training split in some pools. Raises UserError if a pool has
    none."""
    return [query for pool in pools for query in read_queries(store, "train", pool)]


def split_queries(
    store: Store, train: ContrastiveTrainConfig, seed: int
) -> tuple[list[RetrievalQuery], list[RetrievalQuery]]:
    """Return the training queries of `train.pools`, and up to `train.validation_queries` queries of
    held-out training scenes. Without `train.hold_out`, all queries of the training split are
    trained on, and some of them returned a second time.

    Raises:
        UserError: A pool or a list is empty, a batch cannot be filled, or `check_training` raises.
    """
    queries = read_pools(store, train.pools)
    check_training(store, queries, train.hard_negatives)
    held_out = held_out_scenes(store) if train.hold_out else set()
    training = [q for q in queries if q.scene_id not in held_out]
    kept = [q for q in queries if q.scene_id in held_out] if train.hold_out else queries
    # The benchmark lists the queries by type of question; a shuffled part has all types.
    validation = shuffled(kept, seed)[: train.validation_queries]
    check_not_empty(len(training), "training queries")
    check_not_empty(len(validation), "queries of held-out training scenes")
    if len(training) < train.batch:
        raise UserError(
            f"train.batch={train.batch} is more than the {len(training)} training queries of "
            f"{store.folder}: lower it",
            code="batch-too-large",
        )
    return training, validation


class QueryBatchSampler(DefaultBatchSampler):
    """Composes random batches in which, if possible, no query's target is a document (the target or
    a hard negative) of another query.

    A batch has the same `batch` queries whatever the number of ranks; the sampler yields an equal
    part of it for each rank. Queries that do not fill another batch are left out of the epoch.

    Args:
        queries: The training queries.
        negatives: Number of hard negatives of each query that are among its documents.
        batch: Queries per batch, over all ranks.
        seed: Determines the order, together with the epoch.
        world_size: Number of ranks.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        negatives: int,
        batch: int,
        seed: int,
        world_size: int = 1,
    ) -> None:
        super().__init__(queries, batch_size=batch // world_size, drop_last=True, seed=seed)
        self._queries = queries
        self._negatives = negatives
        self._batch = batch
        self._world_size = world_size

    def __len__(self) -> int:
        return len(self._queries) // self._batch * self._world_size

    def __iter__(self) -> Iterator[list[int]]:
        rng = np.random.default_rng([self.seed, self.epoch])
        waiting = rng.permutation(len(self._queries)).tolist()
        for _ in range(len(self._queries) // self._batch):
            batch, waiting = self._next_batch(waiting)
            for start in range(0, self._batch, self.batch_size):
                yield batch[start : start + self.batch_size]

    def _next_batch(self, waiting: list[int]) -> tuple[list[int], list[int]]:
        """Return the next batch of the waiting queries, and the queries that still wait."""
        batch, postponed = [], []
        batch_targets: set[FrameRef] = set()
        batch_documents: set[FrameRef] = set()
        for position, k in enumerate(waiting):
            query = self._queries[k]
            documents = set(documents_of(query, self._negatives))
            if query.target in batch_documents or documents & batch_targets:
                postponed.append(k)
                continue
            batch.append(k)
            batch_targets.add(query.target)
            batch_documents |= documents
            if len(batch) == self._batch:
                return batch, postponed + waiting[position + 1 :]
        # Too few queries are compatible. Add others: the loss masks identical frames.
        missing = self._batch - len(batch)
        return batch + postponed[:missing], postponed[missing:]


def batch_columns(
    queries: Sequence[RetrievalQuery], negatives: int
) -> list[list[RetrievalQuery | FrameRef]]:
    """Return the columns of a batch for `RankingLoss`: the queries, their targets, then a column
    for each hard negative."""
    documents = (documents_of(query, negatives) for query in queries)
    return [list(queries), *map(list, zip(*documents, strict=True))]


def documents_of(query: RetrievalQuery, negatives: int) -> list[FrameRef]:
    """Return a query's target and its first `negatives` hard negatives."""
    return [query.target, *query.hard_negatives[:negatives]]
