"""The queries that a retriever is trained on and measured on, and how batches are composed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from sentence_transformers.base.sampler import DefaultBatchSampler

from conf.errors import UserError
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from data.tracks.retrieval.checks import check_training
from train.common.held_out import check_not_empty, held_out_scenes, shuffled


def split_queries(
    store: Store, batch: int, negatives: int, validation: int, seed: int
) -> tuple[list[RetrievalQuery], list[RetrievalQuery]]:
    """The training queries, and up to `validation` queries of held-out training scenes.

    Raises:
        UserError: There are none, or fewer than a batch; or `check_training` raises.
    """
    queries = store.retrieval("train")
    check_training(store, queries, negatives)
    held_out = held_out_scenes(store)
    training = [q for q in queries if q.scene_id not in held_out]
    # The benchmark lists queries by builder: a shuffled part has queries of every builder.
    measured = shuffled([q for q in queries if q.scene_id in held_out], seed)[:validation]
    check_not_empty(len(training), "training queries")
    check_not_empty(len(measured), "queries of held-out training scenes")
    if len(training) < batch:
        raise UserError(
            f"train.batch={batch} is more than the {len(training)} training queries of "
            f"{store.folder}: lower it",
            code="batch-too-large",
        )
    return training, measured


class QueryBatchSampler(DefaultBatchSampler):
    """Random batches in which, as far as possible, no query's target is a document of another
    query.

    A batch holds `batch` queries over all ranks, in equal consecutive shares, so that its content
    is independent of the world size. Queries that do not fill a batch wait for another epoch.

    Args:
        queries: The training queries.
        negatives: Hard negatives of each query that are documents of its batch.
        batch: Queries in a batch, over all ranks.
        seed: With the epoch, determines the order.
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
        """The next batch of the waiting queries, and the queries that still wait."""
        batch, postponed = [], []
        targets: set[FrameRef] = set()
        ranked: set[FrameRef] = set()
        for position, k in enumerate(waiting):
            query = self._queries[k]
            documents = set(documents_of(query, self._negatives))
            if query.target in ranked or documents & targets:
                postponed.append(k)
                continue
            batch.append(k)
            targets.add(query.target)
            ranked |= documents
            if len(batch) == self._batch:
                return batch, postponed + waiting[position + 1 :]
        # Too few of the remaining queries are compatible: the loss masks identical frames.
        missing = self._batch - len(batch)
        return batch + postponed[:missing], postponed[missing:]


def batch_columns(
    queries: Sequence[RetrievalQuery], negatives: int
) -> list[list[RetrievalQuery | FrameRef]]:
    """Return the columns of a batch as `train.retriever.loss` takes them: the queries, their
    targets, then a column for each hard negative."""
    documents = (documents_of(query, negatives) for query in queries)
    return [list(queries), *map(list, zip(*documents, strict=True))]


def documents_of(query: RetrievalQuery, negatives: int) -> list[FrameRef]:
    """Return a query's target and its first hard negatives."""
    return [query.target, *query.hard_negatives[:negatives]]
