"""Pack several samples into one row without padding, isolated from each other.

A packed row has four rows of positions: each token's position in its own sample, from which the
attention derives where samples begin, and the three of Qwen3-VL's rotary embedding. Transformers
uses the first only if there is neither a cache nor an attention mask. Any other input raises no
error but leaks: tokens attend to the samples before their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn
from transformers import ProcessorMixin

from conf.errors import UserError
from models.compat import attention_implementation
from models.student.collator import IGNORED, Collator, Encoded, stacked_media

Rope = Callable[..., tuple[torch.Tensor, torch.Tensor]]
"""A model's `get_rope_index`: ids, token types and grids of (1, L) tokens to (3, 1, L) positions.
"""


class PackingCollator(Collator):
    """Makes packed batches of one row. `labels` (1, K) belong to the positions that
    `logits_to_keep` (K,) lists; where the following token is another sample's, the label is
    ignored."""

    def __init__(self, processor: ProcessorMixin, max_length: int, rope: Rope) -> None:
        super().__init__(processor, max_length)
        self._rope = rope

    def _batch(self, encoded: Sequence[Encoded], supervised: Sequence[bool]) -> dict[str, Any]:
        return pack(encoded, self._rope, supervised)


def pack(encoded: Sequence[Encoded], rope: Rope, supervised: Sequence[bool]) -> dict[str, Any]:
    """Concatenate samples into one row; the labels of unsupervised ones are ignored."""
    labels, kept, begin = [], [], 0
    for one, learned in zip(encoded, supervised, strict=True):
        # The position before the first supervised token predicts it.
        start = next(k for k, label in enumerate(one.labels) if label != IGNORED) - 1
        response = one.labels[start:]
        labels += response if learned else [IGNORED] * len(response)
        kept += range(begin + start, begin + len(one.labels))
        begin += len(one.labels)
    batch = {
        "input_ids": torch.tensor([[token for one in encoded for token in one.input_ids]]),
        "position_ids": torch.cat([positions(one, rope) for one in encoded], dim=-1),
        "labels": torch.tensor([labels]),
        "logits_to_keep": torch.tensor(kept),
        "use_cache": False,
    }
    return batch | stacked_media(encoded)


def positions(encoded: Encoded, rope: Rope) -> torch.Tensor:
    """Return (4, 1, L): a sample's token positions, and the three of the rotary embedding."""
    ids, types = torch.tensor([encoded.input_ids]), torch.tensor([encoded.mm_token_type_ids])
    grids = {name: encoded.media.get(name) for name in ("image_grid_thw", "video_grid_thw")}
    rotary, _ = rope(input_ids=ids, mm_token_type_ids=types, **grids)
    return torch.cat([torch.arange(ids.shape[1])[None, None], rotary])


def packing_rope(model: nn.Module, packing: str) -> Rope | None:
    """Return the function that gives packed rows their positions, or None to pad micro-batches.

    Args:
        packing: true, false, or auto, which packs with flash attention: it isolates samples at no
            cost.

    Raises:
        UserError: packing is true, and samples would leak into each other with this model or its
            attention.
    """
    base = model.get_base_model() if hasattr(model, "get_base_model") else model
    attention = attention_implementation(base)
    rope = getattr(base.base_model, "get_rope_index", None)
    flash = attention.startswith("flash_attention")
    # The flag `true` arrives as the text True.
    packing = packing.lower()
    if packing == "false" or (packing == "auto" and (rope is None or not flash)):
        return None
    if rope is None:
        raise UserError(
            f"train.packing=true: a {base.config.model_type} has no positions for packed samples, "
            "which would see each other: set train.packing=false",
            code="cannot-pack",
        )
    # Flash attention needs a GPU, where the model may not be yet.
    if not flash and leaks(base):
        raise UserError(
            f"train.packing=true: samples of a row would see each other with this model's "
            f"attention ({attention}): set train.packing=false, or install flash-attn",
            code="cannot-pack",
        )
    return rope


def leaks(model: nn.Module) -> bool:
    """Whether a sample's logits depend on the tokens of the sample before it in a row."""
    length = 4
    row = torch.arange(length).repeat(2)[None]
    device = next(model.parameters()).device
    was_training = model.training
    model.eval()
    logits = []
    with torch.inference_mode():
        for other in (1, 2):
            ids = torch.tensor([[other] * length + [1] * length], device=device)
            logits.append(
                model(
                    input_ids=ids,
                    position_ids=row.expand(4, 1, -1).to(device),
                    logits_to_keep=length,
                    use_cache=False,
                ).logits
            )
    model.train(was_training)
    return not torch.equal(*logits)
