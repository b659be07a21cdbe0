"""The loss of the multi-vector retriever: the single-vector one's, by another similarity."""

from __future__ import annotations

from typing import Any

import torch
from sentence_transformers import MultiVectorEncoder
from sentence_transformers.util.similarity import maxsim
from torch.nn.functional import pad

from conf.runs import world_size
from train.retriever.loss import RankingLoss


class MultiVectorRankingLoss(RankingLoss):
    """Cached multiple-negatives ranking by late interaction over a `Batch`: for the same queries
    its gradients are those of the library's CachedMultiVectorMultipleNegativesRankingLoss.

    Vectors of several queries or frames stand in one tensor, (rows, vectors, width), filled up with
    vectors of zeros, which the library's `maxsim` leaves out.
    """

    similarity = staticmethod(maxsim)

    @staticmethod
    def embed(model: MultiVectorEncoder, given: dict[str, Any], task: str) -> torch.Tensor:
        made = model(given, task=task)
        scored = made["attention_mask"].bool()
        vectors = made["token_embeddings"].masked_fill(~scored[..., None], 0)
        return vectors[:, scored.any(dim=0)]

    def joined(self, parts: list[torch.Tensor]) -> torch.Tensor:
        longest = torch.tensor(max(part.shape[1] for part in parts), device=parts[0].device)
        if world_size() > 1:
            torch.distributed.all_reduce(longest, op=torch.distributed.ReduceOp.MAX)
        return torch.cat([pad(part, (0, 0, 0, int(longest) - part.shape[1])) for part in parts])
