"""Computes what the last token's hidden state needs, in the language tower of a Qwen3-VL.

A retriever with last-token pooling reads one hidden state per input. Up to rounding, it and the
gradients are those of transformers, for less work:

- The inputs of a batch start with the same tokens, those of the prompt. As attention is causal,
  their keys and values are the same in every input, and they are computed once.
- After the keys and values of its attention, the last layer continues with the last token only.
"""

from __future__ import annotations

from typing import Any

import torch
from sentence_transformers.sentence_transformer.modules import Pooling
from torch import Tensor
from torch.nn.functional import pad
from transformers import Qwen3VLTextModel
from transformers.modeling_outputs import BaseModelOutputWithPast
from transformers.models.qwen3_vl.modeling_qwen3_vl import Qwen3VLTextDecoderLayer

from dynapix.models.layers.fast_layers import FastAttention
from dynapix.models.retriever.inputs import Retriever


def compute_last_token(model: Retriever) -> None:
    """Let a Qwen3-VL with last-token pooling compute the hidden states of the last tokens only. It
    then pads every input, on the left. Other models are left unchanged."""
    tower = getattr(model[0].model, "language_model", None)
    pooling = model[1] if len(model) > 1 else None
    is_last = isinstance(pooling, Pooling) and pooling.pooling_mode == "lasttoken"
    if type(tower) is not Qwen3VLTextModel or not is_last:
        return
    model.tokenizer.padding_side = "left"
    # Otherwise, flash attention could get texts without padding, as one row.
    model[0].unpad_inputs = False
    tower.__class__ = LastTokenTower
    layer = tower.layers[-1]
    layer.__class__, layer.self_attn.__class__ = LastTokenLayer, FastAttention
    layer.self_attn.last_only = True


class LastTokenTower(Qwen3VLTextModel):
    """A language tower that returns the hidden states of the last tokens, and zeros for the others.
    Inputs must be padded on the left."""

    def forward(
        self,
        input_ids: None = None,
        past_key_values: None = None,
        *,
        inputs_embeds: Tensor,
        attention_mask: Tensor,
        position_ids: Tensor | None,
        visual_pos_masks: Tensor | None = None,
        **settings: Any,
    ) -> BaseModelOutputWithPast:
        size, length = inputs_embeds.shape[:2]
        if position_ids is None:
            # Positions must start after the padding, so that those of the prompt are the same.
            position_ids = (attention_mask.cumsum(dim=1) - 1).clamp(min=0).expand(4, -1, -1)
        padding = (attention_mask == 0).sum(dim=1, keepdim=True)
        # Where each input's first tokens are: those of its prompt, if all inputs have them.
        rows = torch.arange(size, device=padding.device)[:, None]
        columns = padding + torch.arange(length - int(padding.max()), device=padding.device)
        starts = inputs_embeds[rows, columns]
        is_shared = (starts == starts[:1]).all(dim=-1).all(dim=0)
        if visual_pos_masks is not None:
            is_shared &= ~visual_pos_masks[rows, columns].any(dim=0)
        count = int(is_shared[:-1].cumprod(dim=0).sum())
        # Layers that are computed again in the backward pass cannot use a cache.
        if size == 1 or count == 0 or (self.training and self.gradient_checkpointing):
            return super().forward(
                inputs_embeds=inputs_embeds,
                attention_mask=attention_mask,
                position_ids=position_ids,
                visual_pos_masks=visual_pos_masks,
                **settings,
            )
        position_ids = position_ids.expand(-1, size, -1)
        shared = slice(int(padding[0]), int(padding[0]) + count)
        prompt = super().forward(
            inputs_embeds=inputs_embeds[:1, shared],
            position_ids=position_ids[:, :1, shared],
            use_cache=True,
        )
        cache = prompt.past_key_values
        cache.batch_repeat_interleave(size)
        is_rest = attention_mask.new_ones((size, length), dtype=torch.bool)
        is_rest[rows, columns[:, :count]] = False

        def rest(tensor: Tensor) -> Tensor:
            return tensor[is_rest].view(size, length - count, *tensor.shape[2:])

        outputs = super().forward(
            inputs_embeds=rest(inputs_embeds),
            attention_mask=pad(rest(attention_mask), (count, 0), value=1),
            position_ids=torch.stack([rest(each) for each in position_ids]),
            visual_pos_masks=None if visual_pos_masks is None else rest(visual_pos_masks),
            past_key_values=cache,
            **settings | {"use_cache": False},
        )
        return BaseModelOutputWithPast(pad(outputs.last_hidden_state, (0, 0, count, 0)))


class LastTokenLayer(Qwen3VLTextDecoderLayer):
    """A layer that returns the hidden states of the last tokens, and zeros for the others."""

    def forward(self, hidden_states: Tensor, *args: Any, **settings: Any) -> Tensor:
        attended, _ = self.self_attn(self.input_layernorm(hidden_states), *args, **settings)
        last = hidden_states[:, -1:] + attended
        last = last + self.mlp(self.post_attention_layernorm(last))
        return pad(last, (0, 0, hidden_states.shape[1] - 1, 0))
