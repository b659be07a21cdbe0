"""The retriever's loss: multiple-negatives ranking at several widths, with cached gradients.

As in GradCache (Gao et al., 2021), a batch is embedded twice, one mini-batch at a time. The first
pass, without gradients, computes embeddings, from which the loss and its gradients with respect to
the embeddings are computed. The second pass propagates these gradients to the weights. Each pass
loads the inputs of a mini-batch when it reaches it, so memory does not depend on the batch size.

If all queries of a batch fit in one mini-batch, a single process embeds the batch only once, with
gradients, and memory holds the activations of the whole batch.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from typing import Any, TypeVar

import torch
from accelerate.utils import gather_object
from sentence_transformers.base.losses.gradcache import RandContext
from sentence_transformers.util import all_gather_padded, cat_padded_token_embeddings
from sentence_transformers.util.similarity import maxsim
from torch import nn
from torch.nn.functional import cross_entropy, normalize

from dynapix.conf.runs import rank, world_size
from dynapix.data.records import FrameRef
from dynapix.models.retriever.inputs import QueryOrFrame, Retriever, check_finite, forward
from dynapix.train.retriever.inputs import RetrieverInputs

In = TypeVar("In")
Out = TypeVar("Out")


class RankingLoss(nn.Module):
    """The cross entropy of each query's target among all documents, summed over widths.

    Documents are the targets and hard negatives of all queries of a batch, on all ranks. A document
    that is the same frame as a query's target is not a negative of that query.

    Args:
        model: The retriever.
        inputs: Loads the inputs of a mini-batch.
        widths: Embedding sizes. The loss at a width scores that many leading entries of a vector.
        scale: Inverse temperature of the scores.
        mini_batch: Queries or frames per mini-batch. The gradients do not depend on it.
        prefetch: Number of mini-batches that a thread loads in advance.
    """

    def __init__(
        self,
        model: Retriever,
        inputs: RetrieverInputs,
        *,
        widths: Sequence[int],
        scale: float,
        mini_batch: int,
        prefetch: int = 0,
    ) -> None:
        super().__init__()
        # With several ranks, the trainer replaces this attribute by the model wrapped in DDP.
        self.model = model
        self._inputs = inputs
        self._widths, self._scale = widths, scale
        self._mini_batch, self._prefetch = mini_batch, prefetch

    def forward(
        self, columns: Sequence[Sequence[QueryOrFrame]], labels: None = None
    ) -> torch.Tensor:
        """Return the loss of a batch. Its `backward` runs the second pass, if there are two.

        Args:
            columns: The queries, their targets, then a column for each hard negative.
            labels: Not used; the trainer passes None.

        Raises:
            UserError: an embedding is not finite.
        """
        size = self._mini_batch
        parts = [c[start : start + size] for c in columns for start in range(0, len(c), size)]
        # With DDP, several forward passes before a backward pass may mark a weight as ready twice.
        is_single_pass = len(parts) == len(columns) and world_size() == 1
        states, vectors, masks = [], [], []
        for part, inputs in self._load(parts, is_first_of_two=not is_single_pass):
            states.append(RandContext(*inputs.values()))
            with nullcontext() if is_single_pass else torch.no_grad():
                embedded, mask = self._embed(part, inputs)
            check_finite(embedded, part)
            vectors.append(embedded)
            masks.append(mask)
        if is_single_pass:
            return self._score(columns, vectors, masks)
        for part in vectors:
            part.requires_grad_()
        loss = self._score(columns, vectors, masks)
        loss.backward()
        gradients = [part.grad for part in vectors]
        loss = loss.detach().requires_grad_()
        loss.register_hook(partial(self._propagate, parts, states, gradients))
        return loss

    def _load(
        self, parts: Sequence[Sequence[QueryOrFrame]], is_first_of_two: bool
    ) -> Iterator[tuple[Sequence[QueryOrFrame], dict[str, Any]]]:
        """Yield each mini-batch with its inputs on the model's device."""
        loaded = prefetched(self._inputs.load, parts, self._prefetch)
        for part, inputs in zip(parts, loaded, strict=True):
            yield part, self._inputs.prepare(part, inputs, is_first_of_two)

    def _embed(
        self, part: Sequence[QueryOrFrame], inputs: dict[str, Any]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return vectors (items, vectors, width), and a mask (items, vectors) of scored vectors."""
        task = "document" if isinstance(part[0], FrameRef) else "query"
        outputs = forward(self.model, inputs, task)
        if (single := outputs.get("sentence_embedding")) is not None:
            return single[:, None], single.new_ones(len(single), 1, dtype=torch.bool)
        return outputs["token_embeddings"], outputs["attention_mask"].bool()

    def _score(
        self,
        columns: Sequence[Sequence[QueryOrFrame]],
        vectors: Sequence[torch.Tensor],
        masks: Sequence[torch.Tensor],
    ) -> torch.Tensor:
        """Return the loss of a batch, given the vectors and masks of its mini-batches."""
        split = math.ceil(len(columns[0]) / self._mini_batch)
        queries, query_mask = cat_padded_token_embeddings(vectors[:split], masks[:split])
        documents, document_mask = cat_padded_token_embeddings(vectors[split:], masks[split:])
        frames = [frame for column in columns[1:] for frame in column]
        targets = torch.arange(len(queries), device=queries.device) + rank() * len(frames)
        if world_size() > 1:
            documents, document_mask = all_gather_padded(documents, document_mask, with_grad=True)
            frames = gather_object(frames)
        identical = identical_frames(frames, targets)
        loss = torch.zeros((), device=queries.device)
        for width in self._widths:
            cut = [normalize(v[..., :width], dim=-1) for v in (queries, documents)]
            scores = self._scale * maxsim(*cut, query_mask, document_mask)
            loss += cross_entropy(scores.masked_fill(identical, -torch.inf), targets)
        return loss

    def _propagate(
        self,
        parts: Sequence[Sequence[QueryOrFrame]],
        states: Sequence[RandContext],
        gradients: Sequence[torch.Tensor],
        factor: torch.Tensor,
    ) -> None:
        """Embed again, with the same dropout, and propagate `factor` times the gradients."""
        for k, (part, inputs) in enumerate(self._load(parts, is_first_of_two=False)):
            # Ranks average their gradients once, after the last mini-batch.
            defer = k < len(parts) - 1 and world_size() > 1
            with self.model.no_sync() if defer else nullcontext(), torch.enable_grad(), states[k]:
                embedded, _ = self._embed(part, inputs)
                # A frozen image tower has no gradient.
                if embedded.requires_grad:
                    (factor * (embedded.float() * gradients[k].float()).sum()).backward()


def identical_frames(frames: Sequence[FrameRef], targets: torch.Tensor) -> torch.Tensor:
    """Return a mask (targets, frames) of the frames that equal a target but are at other positions.

    Args:
        targets: Positions of the targets among `frames`.
    """
    numbers = {frame: k for k, frame in enumerate(frames)}
    codes = torch.tensor([numbers[frame] for frame in frames], device=targets.device)
    identical = codes[targets, None] == codes
    return identical.scatter(1, targets[:, None], False)


def prefetched(load: Callable[[In], Out], items: Sequence[In], ahead: int) -> Iterator[Out]:
    """Yield `load(item)` of each item in order. A thread loads up to `ahead` items in advance; only
    one thread, because threads must not share a tokenizer."""
    if not ahead:
        # Use no thread: its own pool of OpenMP threads would compete with the model's for cores.
        yield from map(load, items)
        return
    with ThreadPoolExecutor(1) as pool:
        waiting: deque[Future[Out]] = deque()
        for item in items:
            waiting.append(pool.submit(load, item))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        for future in waiting:
            yield future.result()
