"""Batches of the retriever by name: which queries stand in one, and what they are held against."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from sentence_transformers.base.sampler import DefaultBatchSampler

from data.records import FrameRef, RetrievalQuery


@dataclass(frozen=True)
class Batch:
    """Queries and the frames that they are contrasted with. No pixels: those are read a mini-batch
    at a time.

    `prefixes` counts, prefix by prefix, the queries side by side that share it. Row j of `columns`
    (1 + negatives, B) says where in `frames` each query's target (j = 0) and hard negatives stand.
    """

    queries: list[RetrievalQuery]
    prefixes: list[int]
    frames: list[FrameRef]
    columns: torch.Tensor

    def documents(self) -> list[list[FrameRef]]:
        """Each query's target and hard negatives."""
        return [[self.frames[k] for k in row] for row in self.columns.T.tolist()]

    def groups(self, first: int, last: int) -> list[list[RetrievalQuery]]:
        """The queries of a range of prefixes, prefix by prefix."""
        bounds = self._bounds
        return [self.queries[bounds[k] : bounds[k + 1]] for k in range(first, last)]

    @cached_property
    def _bounds(self) -> list[int]:
        # Made once: mining asks for every range of a whole pool.
        return [0, *accumulate(self.prefixes)]

    def query_names(self, first: int, last: int) -> list[str]:
        """Of the queries of a range of prefixes."""
        return [query_title(q) for group in self.groups(first, last) for q in group]

    def frame_names(self, first: int, last: int) -> list[str]:
        return [frame_title(f) for f in self.frames[first:last]]


def query_title(query: RetrievalQuery) -> str:
    """What a query is called where something is wrong with it."""
    return f"query {query.query_id}"


def frame_title(frame: FrameRef) -> str:
    return f"frame {frame.frame} of {frame.scene_id}"


def batch_of(
    queries: Sequence[RetrievalQuery], negatives: int, distinct: bool, shared: bool
) -> Batch:
    """A batch of these queries with so many hard negatives each. `distinct` lists a frame that
    several queries name once, `shared` puts queries of one prefix together."""
    groups: dict[object, list[RetrievalQuery]] = {}
    for k, query in enumerate(queries):
        groups.setdefault(prefix_of(query) if shared else k, []).append(query)
    ordered = [query for group in groups.values() for query in group]
    documents = [[query.target, *query.hard_negatives[:negatives]] for query in ordered]
    named = [frame for column in zip(*documents, strict=True) for frame in column]
    if distinct:
        places = {frame: k for k, frame in enumerate(dict.fromkeys(named))}
        columns = [places[frame] for frame in named]
        named = list(places)
    else:
        columns = list(range(len(named)))
    return Batch(
        queries=ordered,
        prefixes=[len(group) for group in groups.values()],
        frames=named,
        columns=torch.tensor(columns).view(1 + negatives, len(ordered)),
    )


def prefix_of(query: RetrievalQuery) -> tuple[str, int, int]:
    """What a query shows, whatever it asks."""
    return query.scene_id, query.prefix_start, query.prefix_stop


class QueryBatchSampler(DefaultBatchSampler):
    """Batches of an epoch, composed by a rule: `random`; `scenes`, where `together` queries of a
    scene stand side by side; or `spread`, with as few of a scene in a batch as can be. As far as
    can be, no frame is one query's target and shown for another too: it would be its own negative.

    A batch is `batch` queries over all `ranks`, in equal shares that come one after the other as
    the ranks take them: what it holds does not hang on how many ranks there are. The queries that
    fill no batch wait for another epoch, in which chance leaves out others.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        negatives: int,
        batch: int,
        rule: str,
        together: int,
        seed: int,
        ranks: int = 1,
    ) -> None:
        super().__init__(queries, batch_size=batch // ranks, drop_last=True, seed=seed)
        self._queries = queries
        self._negatives = negatives
        self._batch = batch
        self._rule, self._together = rule, together
        self._ranks = ranks

    def __len__(self) -> int:
        return len(self._queries) // self._batch * self._ranks

    def __iter__(self) -> Iterator[list[int]]:
        rng = np.random.default_rng([self.seed, self.epoch])
        waiting = ORDERS[self._rule](self._queries, rng, self._together)
        for _ in range(len(self._queries) // self._batch):
            batch, waiting = self._taken(waiting)
            for start in range(0, self._batch, self.batch_size):
                yield batch[start : start + self.batch_size]

    def _taken(self, waiting: list[int]) -> tuple[list[int], list[int]]:
        """The next batch of those that wait, and who waits on."""
        batch, passed = [], []
        targets: set[FrameRef] = set()
        shown: set[FrameRef] = set()
        for place, k in enumerate(waiting):
            query = self._queries[k]
            documents = {query.target, *query.hard_negatives[: self._negatives]}
            if query.target in shown or documents & targets:
                passed.append(k)
                continue
            batch.append(k)
            targets.add(query.target)
            shown |= documents
            if len(batch) == self._batch:
                return batch, passed + waiting[place + 1 :]
        # Too few are left that go together.
        lacking = self._batch - len(batch)
        return batch + passed[:lacking], passed[lacking:]


def in_random_order(
    queries: Sequence[RetrievalQuery], rng: np.random.Generator, together: int
) -> list[int]:
    return rng.permutation(len(queries)).tolist()


def scene_by_scene(
    queries: Sequence[RetrievalQuery], rng: np.random.Generator, together: int
) -> list[int]:
    """Each scene's queries in runs of `together`, the runs in random order."""
    runs = [
        own[start : start + together]
        for own in by_scene(queries, rng)
        for start in range(0, len(own), together)
    ]
    return [k for place in rng.permutation(len(runs)) for k in runs[place]]


def spread_out(
    queries: Sequence[RetrievalQuery], rng: np.random.Generator, together: int
) -> list[int]:
    """Each scene's queries at even distances, from a random place on."""
    places = np.empty(len(queries))
    for own in by_scene(queries, rng):
        places[own] = (np.arange(len(own)) + rng.random()) / len(own)
    return np.argsort(places, kind="stable").tolist()


def by_scene(queries: Sequence[RetrievalQuery], rng: np.random.Generator) -> list[list[int]]:
    """Each scene's queries, in random order."""
    found: dict[str, list[int]] = {}
    for k in rng.permutation(len(queries)).tolist():
        found.setdefault(queries[k].scene_id, []).append(k)
    return list(found.values())


ORDERS = {"random": in_random_order, "scenes": scene_by_scene, "spread": spread_out}
"""Orders of an epoch, by the name of their rule."""
