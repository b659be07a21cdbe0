"""Several samples in one row, without padding, that do not see each other.

A packed row has four rows of positions: where each token stands in its own sample, from which the
attention learns where samples begin, and the three of Qwen3-VL's rotary embedding. transformers
heeds the first only where there is neither a cache nor an attention mask. All else is no error but
a leak: tokens would attend to the samples before their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn
from transformers import ProcessorMixin

from conf.errors import UserError
from models.student.collator import IGNORED, Collator, Encoded, encode, stacked_media
from models.student.prompts import Sample

Rope = Callable[..., tuple[torch.Tensor, torch.Tensor]]
"""A model's `get_rope_index`: ids, token types and grids of (1, L) tokens to (3, 1, L) positions.
"""


class PackingCollator(Collator):
    """Makes a packed batch of conversations: what the model's `forward` takes, and `labels`.

    As of a padded batch, `labels` (1, K) belong to the positions that `logits_to_keep` (K,) names,
    and position j's logits predict label j + 1; what would predict another sample's token has a
    label that is ignored.
    """

    def __init__(self, processor: ProcessorMixin, max_length: int, rope: Rope) -> None:
        super().__init__(processor, max_length)
        self._rope = rope

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length) for s in samples]
        return pack(encoded, self._rope, [s.supervised for s in samples])


def pack(encoded: Sequence[Encoded], rope: Rope, supervised: Sequence[bool]) -> dict[str, Any]:
    """One row of all samples' tokens, with the rows of the head that predict responses; the labels
    of those that are not `supervised` are ignored."""
    labels, kept, begin = [], [], 0
    for one, learnt in zip(encoded, supervised, strict=True):
        # The position before the first supervised token predicts it.
        start = next(k for k, label in enumerate(one.labels) if label != IGNORED) - 1
        told = one.labels[start:]
        labels += told if learnt else [IGNORED] * len(told)
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
    """(4, 1, L) positions of a sample's tokens: in it, and the rotary embedding's three."""
    ids, types = torch.tensor([encoded.input_ids]), torch.tensor([encoded.mm_token_type_ids])
    grids = {name: encoded.media.get(name) for name in ("image_grid_thw", "video_grid_thw")}
    rotary, _ = rope(input_ids=ids, mm_token_type_ids=types, **grids)
    return torch.cat([torch.arange(ids.shape[1])[None, None], rotary])


def rope_of(model: nn.Module, packing: str) -> Rope | None:
    """What gives a packed row its positions, or None where micro-batches are padded: `packing` is
    true, false, or auto, which packs where flash attention keeps samples apart at no cost.

    Raises:
        UserError: packing is asked for, and this model or its attention would let samples leak
            into each other.
    """
    base = model.get_base_model() if hasattr(model, "get_base_model") else model
    attention = base.config.get_text_config()._attn_implementation
    rope = getattr(base.base_model, "get_rope_index", None)
    flash = attention.startswith("flash_attention")
    # A flag's true is the text True in the settings.
    packing = packing.lower()
    if packing == "false" or (packing == "auto" and (rope is None or not flash)):
        return None
    if rope is None:
        raise UserError(
            f"train.packing=true: a {base.config.model_type} takes no positions of packed "
            "samples, which would see each other; give train.packing=false"
        )
    # Flash attention wants a GPU, where the model may not be yet.
    if not flash and leaks(base):
        raise UserError(
            f"train.packing=true: samples of one row would see each other with this model's "
            f"attention ({attention}); give train.packing=false, or install flash-attn"
        )
    return rope


def leaks(model: nn.Module) -> bool:
    """Whether a sample's logits change with the tokens of the one before it in a row."""
    length = 4
    row = torch.arange(length).repeat(2)[None]
    device = next(model.parameters()).device
    was_training = model.training
    model.eval()
    found = []
    with torch.inference_mode():
        for other in (1, 2):
            ids = torch.tensor([[other] * length + [1] * length], device=device)
            found.append(
                model(
                    input_ids=ids,
                    position_ids=row.expand(4, 1, -1).to(device),
                    logits_to_keep=length,
                    use_cache=False,
                ).logits
            )
    model.train(was_training)
    return not torch.equal(*found)
