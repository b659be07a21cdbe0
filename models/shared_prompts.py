"""Computes the start that samples of a batch share once, in the language tower of a Qwen3-VL.

The samples of an item in reasoning mode and in answer mode show the same frames; their prompts
differ in the last instruction. As attention is causal, the hidden states of a shared start do not
depend on what follows it. Up to rounding, all hidden states and gradients are those of
transformers. Dropout, however, drops the same values of a shared start in all its samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from transformers import Qwen3VLTextModel
from transformers.masking_utils import create_causal_mask
from transformers.modeling_outputs import BaseModelOutputWithPast


class SharedPromptTower(Qwen3VLTextModel):
    """A language tower that computes shared starts once in training.

    Flash attention takes no mask for the rest of several samples in one row: with it, nothing is
    shared.
    """

    def forward(
        self,
        input_ids: Tensor | None = None,
        *,
        inputs_embeds: Tensor | None = None,
        attention_mask: Tensor | None = None,
        position_ids: Tensor | None = None,
        visual_pos_masks: Tensor | None = None,
        deepstack_visual_embeds: list[Tensor] | None = None,
        **settings: Any,
    ) -> BaseModelOutputWithPast:
        packing = None
        has_masks = "flash" not in self.config._attn_implementation
        if self.training and position_ids is not None and has_masks:
            packing = pack_samples(inputs_embeds, attention_mask)
        if packing is None:
            return super().forward(
                input_ids,
                inputs_embeds=inputs_embeds,
                attention_mask=attention_mask,
                position_ids=position_ids,
                visual_pos_masks=visual_pos_masks,
                deepstack_visual_embeds=deepstack_visual_embeds,
                **settings,
            )
        if visual_pos_masks is not None:
            # The features are in the order of the batch's visual tokens.
            order = (visual_pos_masks.flatten().cumsum(0) - 1).view_as(visual_pos_masks)
            visual_pos_masks = packing.take(visual_pos_masks) & (packing.parts != PADDING)
            kept = packing.take(order)[visual_pos_masks]
            deepstack_visual_embeds = [features[kept] for features in deepstack_visual_embeds]
        positions = position_ids.expand(-1, len(inputs_embeds), -1)
        inputs_embeds = packing.take(inputs_embeds)
        outputs = super().forward(
            inputs_embeds=inputs_embeds,
            attention_mask=create_causal_mask(
                self.config, inputs_embeds, packing.parts != PADDING, None,
                and_mask_function=packing.is_visible,
            ),
            position_ids=torch.stack([packing.take(each) for each in positions]),
            visual_pos_masks=visual_pos_masks,
            deepstack_visual_embeds=deepstack_visual_embeds,
            **settings | {"use_cache": False},
        )  # fmt: skip
        hidden = outputs.last_hidden_state[packing.rows[:, None], packing.places]
        return BaseModelOutputWithPast(last_hidden_state=hidden)


PADDING, SHARED = -1, 0


@dataclass(frozen=True)
class Packing:
    """Where the tokens of B samples of length L are in R rows of length M, which are padded on the
    left. A row has a shared start, then the rest of each of its samples.

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
    """Pack samples that start with the same embeddings, for at least half of the shorter one.

    Args:
        embeds: (B, L, width) embeddings of the samples' tokens.
        mask: (B, L), 0 for padding, which is on the left.

    Returns:
        The packing; None if attention would not become cheaper.
    """
    size, length = mask.shape
    firsts = mask.argmax(dim=1).tolist()
    groups = group_samples(embeds, firsts)
    widths = [count + sum(length - firsts[s] - count for s in members) for members, count in groups]
    width = max(widths)
    if len(groups) == size or len(groups) * width**2 > size * length**2:
        return None
    shape = len(groups), width
    samples, columns = torch.zeros(shape).long(), torch.zeros(shape).long()
    parts = torch.full(shape, PADDING)
    rows, places = torch.zeros(size).long(), torch.zeros(size, length).long()
    for row, (members, count) in enumerate(groups):
        start = width - widths[row]
        stop = start + count
        parts[row, start:stop] = SHARED
        samples[row, start:stop] = members[0]
        columns[row, start:stop] = torch.arange(count) + firsts[members[0]]
        for part, sample in enumerate(members, 1):
            first, rest = firsts[sample], firsts[sample] + count
            own = slice(stop, stop + length - rest)
            parts[row, own], samples[row, own] = part, sample
            columns[row, own] = torch.arange(rest, length)
            rows[sample] = row
            places[sample, first:rest] = torch.arange(start, start + count)
            places[sample, rest:] = torch.arange(own.start, own.stop)
            stop = own.stop
    return Packing(*(t.to(mask.device) for t in (samples, columns, parts, rows, places)))


def group_samples(embeds: Tensor, firsts: list[int]) -> list[tuple[list[int], int]]:
    """Return the samples of each row, and the length of their shared start.

    Args:
        firsts: The index of each sample's first token.
    """
    groups: list[tuple[list[int], int]] = []
    for sample, first in enumerate(firsts):
        own = embeds[sample, first:]
        for k, (members, count) in enumerate(groups):
            other = embeds[members[0], firsts[members[0]] :]
            shorter = min(len(own), len(other))
            equal = (own[:shorter] == other[:shorter]).all(dim=-1)
            shared = min(count, int(equal.cumprod(dim=0).sum()))
            if 2 * shared >= shorter:
                groups[k] = [*members, sample], shared
                break
        else:
            groups.append(([sample], len(own)))
    return groups
