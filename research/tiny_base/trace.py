"""Record what the losses of the tiny base are computed from: hidden states, queries and keys. And
the losses that train attention heads to attend to given tokens."""

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

from dynapix.data.records import LETTERS
from dynapix.models.student.collator import MEDIA
from research.tiny_base.oracle_targets import PICTURES, OracleTargets

PRECEDING, TRACKING, MIDDLE, NAMING, RECALLING, SPEAKING, CHOOSING = 0, 1, 2, 3, 4, 5, 6
"""Indices of the language layers that `research.tiny_base.heads` and `pointing_losses` refer to."""


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


def pointing_losses(trace: Trace, targets: OracleTargets) -> dict[str, Tensor]:
    """Return the losses of attention heads: the negative logarithm of the attention weight from a
    token to the token that it should attend to.

    loss                layer, head    from -> to
    before              PRECEDING 0    token of a text -> the token before it
    second before       PRECEDING 1    token of a text -> the second token before it
    label               PRECEDING 2    visual token of a candidate -> its letter in the prompt
    track clip          TRACKING 0     object in a candidate -> the same object at the end of the
                                       clip
    track k             TRACKING 2+k   object in a candidate -> the same object in candidate k, an
                                       earlier one, or, if it does not show the object, the first
                                       token of the sequence
    letter              TRACKING 1     name in a text about a candidate -> the candidate's letter in
                                       the text
    find k              NAMING k       name -> the object in picture k, or, if the picture does not
                                       show it, the first token of the sequence
    find shown          NAMING 5       name -> likewise, in the picture that the text describes
    subject             RECALLING 0    token that describes an object -> the object's name
    repeat              RECALLING 1    token before a repeated name -> the name's last mention
    reference           RECALLING 2    token that describes the sphere in "the cube has the sphere
                                       left of it" -> the cube's name
    verdict             SPEAKING 0     token before a letter in an outcome -> "agrees" of this
                                       candidate, or its letter after "closest"
    next in clip        SPEAKING 1     token before a new name in a scene parse -> the object at the
                                       end of the clip
    next in candidates  SPEAKING 2     token before a name that is new in a text, or in its
                                       predictions -> the object in the last candidate that shows it
    match               SPEAKING 3     letter in a line that says whether a candidate matches ->
                                       the last letter in the outcome
    choice              CHOOSING 0     token before a letter after "closest" -> the last
                                       token about the object in this candidate

    The two preceding tokens allow later layers to find what followed an earlier use of the same
    words. The letters allow a text about a candidate to find the candidate's visual tokens.
    """
    losses = {}
    row, start, end = targets.tracked_to_clip.T
    if len(row):
        query, key = targets.visual[row, start], targets.visual[row, end]
        losses["track clip"] = -trace.log_attention(TRACKING, 0, row, query, key).mean()
    for k in range(len(LETTERS) - 1):
        row, start, _, end = targets.tracked_to_candidates[
            targets.tracked_to_candidates[:, 2] == k
        ].T
        if len(row):
            query, key = targets.visual[row, start], locate_objects(row, end, targets)
            weights = trace.log_attention(TRACKING, 2 + k, row, query, key)
            losses[f"track {k}"] = -weights.mean()
    for head in range(PICTURES):
        named = targets.has_picture[targets.names[:, 0], head]
        row, query = targets.names[named].T
        if len(row):
            key = locate_objects(row, targets.name_tokens[named, head], targets)
            losses[f"find {head}"] = -trace.log_attention(NAMING, head, row, query, key).mean()
    row, position = targets.text_tokens.T
    before, second_before = (torch.stack([row, position, position - k], dim=1) for k in (1, 2))
    row, query, token = targets.next_in_clip.T
    next_in_clip = torch.stack([row, query, targets.visual[row, token]], dim=1)
    row, query, token = targets.next_in_candidates.T
    next_in_candidates = torch.stack([row, query, targets.visual[row, token]], dim=1)
    row, query, token = targets.described_tokens.T
    shown = torch.stack([row, query, locate_objects(row, token, targets)], dim=1)
    for name, layer, head, pairs in (
        ("before", PRECEDING, 0, before),
        ("second before", PRECEDING, 1, second_before),
        ("label", PRECEDING, 2, targets.prompt_letters),
        ("letter", TRACKING, 1, targets.text_letters),
        ("find shown", NAMING, PICTURES, shown),
        ("subject", RECALLING, 0, targets.subjects),
        ("repeat", RECALLING, 1, targets.repeats),
        ("reference", RECALLING, 2, targets.references),
        ("verdict", SPEAKING, 0, targets.verdicts),
        ("choice", CHOOSING, 0, targets.choices),
        ("next in clip", SPEAKING, 1, next_in_clip),
        ("next in candidates", SPEAKING, 2, next_in_candidates),
        ("match", SPEAKING, 3, targets.matches),
    ):
        row, query, key = pairs.T
        if len(row):
            losses[name] = -trace.log_attention(layer, head, row, query, key).mean()
    return losses


def locate_objects(row: Tensor, token: Tensor, targets: OracleTargets) -> Tensor:
    """Return the positions of visual tokens in the sequence, and that of its first token for -1."""
    return targets.visual[row, token].where(token >= 0, targets.start[row])
