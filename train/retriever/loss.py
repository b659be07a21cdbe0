"""The retriever's loss: the library's cached ranking loss over batches that hold names.

Inputs are made a mini-batch at a time, ahead of the pass that takes them, so that memory does not
grow with a batch's pixels. Frames that several queries name are embedded once, a prefix that they
share passes once, and the frozen tower's outputs of the first pass are given to the second: none of
these changes a gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from typing import Any, TypeVar

import torch
from accelerate.utils import gather_object
from sentence_transformers import SentenceTransformer
from sentence_transformers.base.losses.gradcache import RandContext
from sentence_transformers.sentence_transformer.losses import CachedMultipleNegativesRankingLoss
from sentence_transformers.util import all_gather_with_grad, cos_sim
from torch.nn.functional import cross_entropy

from conf.runs import rank, world_size
from models.nonfinite_guard import check_finite
from train.retriever.batches import Batch
from train.retriever.inputs import RetrieverInputs
from train.retriever.negatives import Weighing

Made = TypeVar("Made")
Asked = TypeVar("Asked")
Range = tuple[int, int]


class RankingLoss(CachedMultipleNegativesRankingLoss):
    """Cached multiple-negatives ranking over a `Batch`. For the same queries its gradients are the
    library's, on any number of ranks, unless a `Weighing` changes what negatives count for."""

    def __init__(
        self,
        model: SentenceTransformer,
        inputs: RetrieverInputs,
        weighing: Weighing,
        scale: float,
        mini_batch: int,
        mini_batch_tokens: int | None = None,
        reuse_features: bool = False,
        ahead: int = 0,
    ) -> None:
        """`mini_batch`: prefixes or frames that pass at once; as many as `mini_batch_tokens` hold,
        where that is given. `ahead`: mini-batches that are made while others pass."""
        super().__init__(
            model,
            scale=scale,
            mini_batch_size=mini_batch,
            mini_batch_num_tokens=mini_batch_tokens,
            gather_across_devices=world_size() > 1,
        )
        self._inputs = inputs
        self._weighing = weighing
        self._reuse = reuse_features
        self._ahead = ahead

    def forward(self, features: Sequence[Batch], labels: torch.Tensor | None = None) -> Any:
        (batch,) = features
        self._columns = batch.columns
        self._added = self._weigh(batch)
        # Of its own features the library reads here how many rows they have, and their lengths.
        rows = [
            {
                "attention_mask": filled(self._inputs.prefix_lengths(batch)),
                "make": partial(self._inputs.of_prefixes, batch),
                "kept": {},
                "name": batch.query_names,
                "task": "query",
            },
            {
                "attention_mask": filled(self._inputs.frame_lengths(batch)),
                "make": partial(self._inputs.of_frames, batch),
                "kept": {},
                "name": batch.frame_names,
                "task": "document",
            },
        ]
        return self.forward_cached(rows, labels)

    def _weigh(self, batch: Batch) -> torch.Tensor | None:
        """(B, documents of all ranks) what is added to the scores; None where nothing is."""
        if not self._weighing.changes:
            return None
        documents = batch.documents()
        if world_size() > 1:
            documents = gather_object(documents)
        start = rank() * len(batch.queries)
        own = range(start, start + len(batch.queries))
        return self._weighing.added(documents, own).flatten(1)

    def embed_minibatch_iter(
        self,
        sentence_feature: dict[str, Any],
        with_grad: bool,
        copy_random_state: bool,
        random_states: list[RandContext] | None = None,
        ranges: Sequence[Range] = (),
    ) -> Iterator[tuple[torch.Tensor, RandContext | None]]:
        """Embed the rows of each range. What the first pass keeps, the second takes."""
        kept: dict[Range, dict[str, Any]] = sentence_feature["kept"]

        def made(bounds: Range) -> dict[str, Any]:
            return kept.pop(bounds, None) or sentence_feature["make"](*bounds)

        for k, inputs in enumerate(early(made, ranges, self._ahead)):
            with nullcontext() if random_states is None else random_states[k]:
                given = self._inputs.on_device(inputs)
                state = RandContext(*given.values()) if copy_random_state else None
                if self._reuse and not with_grad:
                    given = self._inputs.seen(given)
                    kept[ranges[k]] = {name: on_cpu(value) for name, value in given.items()}
                with torch.set_grad_enabled(with_grad):
                    embedded = self.embed(self.model, given, sentence_feature["task"])
            if not with_grad:
                check_finite(embedded, partial(sentence_feature["name"], *ranges[k]))
            yield embedded, state

    @staticmethod
    def embed(model: SentenceTransformer, given: dict[str, Any], task: str) -> torch.Tensor:
        """(rows, width) of a mini-batch of queries (`task` is query) or of frames (document)."""
        return model(given)["sentence_embedding"]

    def joined(self, parts: list[torch.Tensor]) -> torch.Tensor:
        """What was embedded a mini-batch at a time."""
        return torch.cat(parts)

    similarity = staticmethod(cos_sim)
    """(queries, frames) of embeddings, before it is scaled."""

    def calculate_loss(
        self,
        reps: list[list[torch.Tensor]],
        labels: torch.Tensor | None = None,
        *,
        with_backward: bool = False,
    ) -> torch.Tensor:
        """The mean over a rank's queries of the cross entropy of each one's target among all frames
        that the batch names, on all ranks. Scores of some rows at a time are kept."""
        queries, frames = self.joined(reps[0]), self.joined(reps[1])
        # (B, 1 + negatives, ...): a frame that several queries name gathers its gradients.
        documents = frames[self._columns.T.to(frames.device)]
        if self.gather_across_devices:
            documents = all_gather_with_grad(documents)
        own = (rank() * len(queries) + torch.arange(len(queries))) * documents.shape[1]
        own, shown = own.to(queries.device), documents.flatten(0, 1).detach()
        shown.requires_grad_(with_backward)
        losses = []
        for start in range(0, len(queries), self.mini_batch_size):
            rows = slice(start, start + self.mini_batch_size)
            scores = self.similarity(queries[rows], shown) * self.scale
            if self._added is not None:
                scores = scores + self._added[rows].to(scores.device)
            loss = cross_entropy(scores, own[rows], reduction="sum") / len(queries)
            if with_backward:
                loss.backward()
                loss = loss.detach()
            losses.append(loss)
        if with_backward:
            documents.backward(shown.grad.view_as(documents))
        return torch.stack(losses).sum()


def on_cpu(value: Any) -> Any:
    return value.cpu() if torch.is_tensor(value) else value


def filled(lengths: Sequence[int]) -> torch.Tensor:
    """(rows, longest) an attention mask of rows of so many tokens."""
    return (torch.arange(max(lengths)) < torch.tensor(lengths)[:, None]).long()


def early(make: Callable[[Asked], Made], asked: Sequence[Asked], ahead: int) -> Iterator[Made]:
    """What is made of each that is asked for, in order, up to `ahead` before they are taken. One
    thread makes them: a tokenizer is not to be shared by several."""
    if not ahead:
        yield from map(make, asked)
        return
    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(make, one) for one in asked[: ahead + 1]]
        for following in range(ahead + 1, len(asked) + ahead + 1):
            made = waiting.pop(0).result()
            if following < len(asked):
                waiting.append(pool.submit(make, asked[following]))
            yield made
