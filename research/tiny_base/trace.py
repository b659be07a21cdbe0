"""Record the hidden states, queries and keys that the losses of the tiny base are computed from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from transformers import PreTrainedModel
from transformers.models.qwen3_vl.modeling_qwen3_vl import apply_rotary_pos_emb

from dynapix.models.student.collator import MEDIA

PRECEDING, TRACKING, MIDDLE, NAMING, RECALLING, SPEAKING, CHOOSING = 0, 1, 2, 3, 4, 5, 6
"""Indices of the language layers that `research.tiny_base.heads` and the attention losses of
`research.tiny_base.pointing` refer to."""


@dataclass
class Trace:
    """What the losses need of a forward pass of the language model.

    Attributes:
        embedded: (B, L, H) inputs of the first layer, with the vision tower's output at the visual
            tokens.
        outputs: (B, L, H) outputs of layers by index.
        queries, keys: (B, L, heads, head size) of layers by index, before rotation.
        rotary: Cosines and sines of the rotary embedding.
        mask: (B, L) attention mask.
    """

    mask: Tensor
    embedded: Tensor = field(init=False)
    outputs: dict[int, Tensor] = field(default_factory=dict)
    queries: dict[int, Tensor] = field(default_factory=dict)
    keys: dict[int, Tensor] = field(default_factory=dict)
    rotary: tuple[Tensor, Tensor] = field(init=False)

    def log_attention(
        self, layer: int, head: int, row: Tensor, query: Tensor, key: Tensor
    ) -> Tensor:
        """Return the logarithms (K,) of the attention weights of a head between K pairs of
        positions in the rows `row` of the batch."""
        cosine, sine = self.rotary
        # Compute all pairs from the first query on: gathering the keys of each pair would copy a
        # key hundreds of times.
        start = int(query.min())
        heads, key_heads = self.queries[layer].shape[2], self.keys[layer].shape[2]
        key_head = head * key_heads // heads
        queries, keys = apply_rotary_pos_emb(
            self.queries[layer][:, :, None, head].transpose(1, 2),
            self.keys[layer][:, :, None, key_head].transpose(1, 2),
            cosine,
            sine,
        )
        queries, keys = queries[:, 0, start:] / math.sqrt(keys.shape[-1]), keys[:, 0]
        scores = (queries @ keys.mT).float()
        position = torch.arange(keys.shape[1], device=keys.device)
        hidden = (position > position[start:, None]) | (self.mask[:, None] == 0)
        # Rows of padding are not masked: a row of -inf would give NaN. They are never read.
        hidden = hidden & (self.mask[:, start:, None] == 1)
        logarithms = scores.masked_fill(hidden, -torch.inf).log_softmax(dim=-1)
        return logarithms[row, query - start, key]


@contextmanager
def trace_forward(language_model: nn.Module, mask: Tensor) -> Iterator[Trace]:
    """Record what the losses need while the language model runs once."""
    trace = Trace(mask)
    layers = language_model.layers

    def keep_inputs(_: nn.Module, __: tuple, settings: dict[str, Any]) -> None:
        trace.embedded = settings["inputs_embeds"]

    def keep_rotary(_: nn.Module, __: tuple, settings: dict[str, Any]) -> None:
        trace.rotary = settings["position_embeddings"]

    def keeper(kept: dict[int, Tensor], layer: int) -> Callable[..., None]:
        def keep(_: nn.Module, __: tuple, output: Tensor) -> None:
            kept[layer] = output

        return keep

    hooks = [language_model.register_forward_pre_hook(keep_inputs, with_kwargs=True)]
    hooks.append(layers[0].self_attn.register_forward_pre_hook(keep_rotary, with_kwargs=True))
    hooks += [
        layers[k].register_forward_hook(keeper(trace.outputs, k))
        for k in (MIDDLE, NAMING, SPEAKING)
    ]
    for k in (PRECEDING, TRACKING, NAMING, RECALLING, SPEAKING, CHOOSING):
        attention = layers[k].self_attn
        hooks.append(attention.q_norm.register_forward_hook(keeper(trace.queries, k)))
        hooks.append(attention.k_norm.register_forward_hook(keeper(trace.keys, k)))
    try:
        yield trace
    finally:
        for hook in hooks:
            hook.remove()


def trace_states(model: PreTrainedModel, batch: Mapping[str, Tensor]) -> Trace:
    """Run a model on a batch without computing logits, and return the trace."""
    inputs = {k: v for k, v in batch.items() if k not in ("labels", "logits_to_keep")}
    with trace_forward(model.model.language_model, batch["attention_mask"]) as trace:
        model.model(**inputs, use_cache=False)
    return trace


def encode_pictures(model: PreTrainedModel, batch: Mapping[str, Tensor]) -> Tensor:
    """Return the vision tower's output (B, T, H) at the visual tokens of each sample."""
    rows = len(batch["input_ids"])
    encoders = {"video": model.get_video_features, "image": model.get_image_features}
    parts = []
    # The clip precedes the images in every sample.
    for kind, encode in encoders.items():
        pixels, grid = (batch.get(name) for name in MEDIA[kind])
        if pixels is not None:
            merged = torch.cat([*encode(pixels, grid).pooler_output])
            parts.append(merged.reshape(rows, -1, merged.shape[-1]))
    return torch.cat(parts, dim=1)


def select_tokens(hidden: Tensor, positions: Tensor) -> Tensor:
    """Return the states (B, T, H) at positions (B, T) of a layer's states (B, L, H)."""
    return hidden[torch.arange(len(hidden), device=hidden.device)[:, None], positions]
