"""Computes the start that samples of a batch share once, in the language tower of a Qwen3-VL.

The samples of an item in reasoning mode and in answer mode show the same frames; their prompts
differ in the last instruction. As attention is causal, the hidden states of a shared start do not
depend on what follows it. Up to rounding, the last hidden states of all tokens but padding, and the
gradients, are those of transformers. Dropout, however, drops the same values of a shared start in
all its samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from transformers import Cache, Qwen3VLTextModel
from transformers.masking_utils import create_causal_mask
from transformers.modeling_outputs import BaseModelOutputWithPast


def shares_prompts(model: nn.Module) -> bool:
    """Return whether a model computes shared starts once in training."""
    towers = (m for m in model.modules() if isinstance(m, SharedPromptTower))
    return any(tower.takes_masks() for tower in towers)


class SharedPromptTower(Qwen3VLTextModel):
    """A language tower that computes shared starts once in training.

    With flash attention, which takes no mask that separates the samples of a row, nothing is
    shared.
    """

    def takes_masks(self) -> bool:
        return "flash" not in self.config._attn_implementation

    def forward(
        self,
        input_ids: Tensor | None = None,
        attention_mask: Tensor | None = None,
        position_ids: Tensor | None = None,
        past_key_values: Cache | None = None,
        inputs_embeds: Tensor | None = None,
        visual_pos_masks: Tensor | None = None,
        deepstack_visual_embeds: list[Tensor] | None = None,
        **settings: Any,
    ) -> BaseModelOutputWithPast:
        packing = None
        is_training = self.training and past_key_values is None and self.takes_masks()
        if is_training and inputs_embeds is not None and attention_mask is not None:
            packing = pack_samples(inputs_embeds, attention_mask)
        if packing is None:
            return super().forward(
                input_ids,
                attention_mask,
                position_ids,
                past_key_values,
                inputs_embeds,
                visual_pos_masks=visual_pos_masks,
                deepstack_visual_embeds=deepstack_visual_embeds,
                **settings,
            )
        if position_ids is None:
            # Positions must start after the padding, so that those of a shared start are the same.
            position_ids = (attention_mask.cumsum(dim=1) - 1).clamp(min=0).expand(4, -1, -1)
        if visual_pos_masks is not None:
            # The features are in the order of the batch's visual tokens.
            order = (visual_pos_masks.flatten().cumsum(0) - 1).view_as(visual_pos_masks)
            visual_pos_masks = packing.take(visual_pos_masks) & (packing.parts != PADDING)
            kept = packing.take(order)[visual_pos_masks]
            deepstack_visual_embeds = [features[kept] for features in deepstack_visual_embeds]
        positions = position_ids.expand(-1, len(inputs_embeds), -1)
        inputs_embeds = packing.take(inputs_embeds)
        mask = create_causal_mask(
            self.config,
            inputs_embeds,
            packing.parts != PADDING,
            None,
            and_mask_function=packing.is_visible,
        )
        outputs = super().forward(
            inputs_embeds=inputs_embeds,
            attention_mask=mask,
            position_ids=torch.stack([packing.take(each) for each in positions]),
            visual_pos_masks=visual_pos_masks,
            deepstack_visual_embeds=deepstack_visual_embeds,
            **settings | {"use_cache": False},
        )
        hidden = outputs.last_hidden_state[packing.rows[:, None], packing.places]
        return BaseModelOutputWithPast(last_hidden_state=hidden)


PADDING, SHARED = -1, 0


@dataclass(frozen=True)
class Packing:
    """Where the tokens of B samples, with padding of length L, are in R rows of length M, which are
    padded on the left. A row has a shared start, then the rest of each of its samples.

    Attributes:
        samples, columns: (R, M) where each token comes from.
        parts: (R, M) PADDING, SHARED, or the number, from 1 on, of the row's sample.
        rows: (B,) the row of each sample.
        places: (B, L) the column in that row of each token of the sample; 0 for its padding.
    """

    samples: Tensor
    columns: Tensor
    parts: Tensor
    rows: Tensor
    places: Tensor

    def take(self, tensor: Tensor) -> Tensor:
        """Rearrange a (B, L, ...) tensor into (R, M, ...)."""
        return tensor[self.samples, self.columns]

    def is_visible(self, row: Tensor, _head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        """Return whether a key in a row is of the shared start or of the same sample as a query."""
        of_key = self.parts[row, key]
        return (of_key == SHARED) | (of_key == self.parts[row, query])


def pack_samples(embeds: Tensor, mask: Tensor) -> Packing | None:
    """Pack samples that start with the same embeddings.

    Args:
        embeds: (B, L, width) embeddings of the samples' tokens.
        mask: (B, L), 0 for padding, on the left or on the right.

    Returns:
        The packing; None if no samples share a row, or if attention would become more expensive.
    """
    size, length = mask.shape
    firsts = mask.argmax(dim=1).tolist()
    stops = (length - mask.flip(1).argmax(dim=1)).tolist()
    groups = group_samples([e[k:n] for e, k, n in zip(embeds, firsts, stops, strict=True)])
    width = max(group.width for group in groups)
    if len(groups) == size or len(groups) * width**2 > size * length**2:
        return None
    shape = len(groups), width
    samples, columns = torch.zeros(shape).long(), torch.zeros(shape).long()
    parts = torch.full(shape, PADDING)
    rows, places = torch.zeros(size).long(), torch.zeros(size, length).long()
    for row, group in enumerate(groups):
        start = width - group.width
        stop = start + group.shared
        first = firsts[group.samples[0]]
        parts[row, start:stop] = SHARED
        samples[row, start:stop] = group.samples[0]
        columns[row, start:stop] = torch.arange(first, first + group.shared)
        for part, sample in enumerate(group.samples, 1):
            rest = firsts[sample] + group.shared
            own = slice(stop, stop + stops[sample] - rest)
            parts[row, own], samples[row, own] = part, sample
            columns[row, own] = torch.arange(rest, stops[sample])
            rows[sample] = row
            places[sample, firsts[sample] : rest] = torch.arange(start, start + group.shared)
            places[sample, rest : stops[sample]] = torch.arange(own.start, own.stop)
            stop = own.stop
    return Packing(*(t.to(mask.device) for t in (samples, columns, parts, rows, places)))


@dataclass(frozen=True)
class Group:
    """Samples in one row.

    Attributes:
        samples: Their indices.
        shared: Length of their shared start.
        width: Length of the row without padding.
    """

    samples: list[int]
    shared: int
    width: int


def group_samples(samples: Sequence[Tensor]) -> list[Group]:
    """Return the rows of samples with (length, width) embeddings. A sample joins the row with the
    longest start in common if attention over the longer row is cheaper than over a row of its own.
    """
    groups: list[Group] = []
    for index, sample in enumerate(samples):
        alone = Group([index], len(sample), len(sample))
        joined = [(join(group, index, samples), k) for k, group in enumerate(groups)]
        best, row = max(joined, key=lambda pair: pair[0].shared, default=(alone, 0))
        if joined and best.width**2 < groups[row].width ** 2 + alone.width**2:
            groups[row] = best
        else:
            groups.append(alone)
    return groups


def join(group: Group, index: int, samples: Sequence[Tensor]) -> Group:
    """Return a group with one more sample."""
    sample, other = samples[index], samples[group.samples[0]]
    longest = min(len(sample), group.shared)
    equal = (sample[:longest] == other[:longest]).all(dim=-1)
    shared = int(equal.cumprod(dim=0).sum())
    members = [*group.samples, index]
    return Group(members, shared, shared + sum(len(samples[k]) - shared for k in members))
