"""Credit for claims: each token of a response gets its part of the reward for true claims."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase

from dynapix.train.rewards import JudgedResponse, credit_claims


def credit_tokens(
    response: JudgedResponse, ids: Sequence[int], tokenizer: PreTrainedTokenizerBase
) -> Tensor:
    """Return the credits (T,) of a response's tokens: those of a claim share its credit, and all
    together sum to `train.rewards.reward_truth`.

    Args:
        ids: The T tokens of the response.
    """
    starts, stops = find_spans(response.text, ids, tokenizer)
    credits = torch.zeros(len(ids))
    for claim, credit in credit_claims(response):
        start, stop = claim.span
        inside = (starts < stop) & (stops > start)
        credits[inside] += credit / inside.sum()
    return credits


def find_spans(
    text: str, ids: Sequence[int], tokenizer: PreTrainedTokenizerBase
) -> tuple[Tensor, Tensor]:
    """Return where each of a text's tokens starts and stops in it, (T,) and (T,).

    The tokens of a sampled text can differ from those into which the tokenizer would divide it.
    """
    ends = [len(tokenizer.decode(ids[: k + 1], skip_special_tokens=True)) for k in range(len(ids))]
    before = len(text) - (ends[-1] if ends else 0)
    stops = before + torch.tensor(ends, dtype=torch.long)
    return torch.cat([torch.tensor([before]), stops])[: len(ids)], stops
