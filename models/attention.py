"""Attention implementations: the fastest one for the machine, with the same results.

The vision tower attends within each frame. Without flash attention, transformers calls it once per
frame; since all frames have one size, one call over all of them gives the same result.

On a CPU in bf16, the backward pass of torch's fused attention takes three to six times as long as
plain matrix products, provided that their scores fit into memory.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import Module
from torch.nn.functional import dropout
from transformers import AttentionInterface, AttentionMaskInterface, PreTrainedModel
from transformers.integrations.sdpa_attention import repeat_kv, sdpa_attention_forward
from transformers.masking_utils import eager_mask
from transformers.utils import is_flash_attn_2_available, is_flash_attn_3_available

PRODUCTS = "dynapix_products"
BY_FRAME = "dynapix_frames_flash"
"""The name must contain "flash": only then does Qwen3-VL's vision tower pass all frames at once,
with their bounds."""
SHORT = 2048
"""Most tokens for which the scores of all pairs are kept for the backward pass."""


def choose_attention(model: PreTrainedModel, precision: str, max_length: int) -> None:
    """Let a Qwen3-VL attend in the fastest way that there is for the machine, for passes in
    `precision` (bf16 or fp32) over up to `max_length` tokens; other models are left as they are.
    """
    if model.config.model_type != "qwen3_vl":
        return
    flash = flash_attention(precision)
    if flash is not None:
        model.set_attn_implementation(flash)
        return
    products = not torch.cuda.is_available() and precision == "bf16" and max_length <= SHORT
    text = PRODUCTS if products else "sdpa"
    model.set_attn_implementation({"text_config": text, "vision_config": BY_FRAME})


def flash_attention(precision: str) -> str | None:
    """Return transformers' name of the installed flash attention for `precision`, or None."""
    if not torch.cuda.is_available() or precision != "bf16":
        return None
    if is_flash_attn_3_available():
        return "flash_attention_3"
    return "flash_attention_2" if is_flash_attn_2_available() else None


def attend_by_products(
    module: Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Any, **settings: Any
) -> tuple[Tensor, None]:
    """Attend from (B, H, Q, D) queries to (B, G, K, D) keys and values; return (B, Q, H, D).

    Unlike transformers' eager attention, only the softmax of the scores is kept, in the precision
    of the products: a third of the memory.
    """
    groups = query.shape[1] // key.shape[1]
    key, value = repeat_kv(key, groups), repeat_kv(value, groups)
    scores = torch.matmul(query * settings["scaling"], key.transpose(2, 3))
    if attention_mask is not None:
        scores.add_(attention_mask)
    weights = dropout(scores.softmax(dim=-1), settings.get("dropout", 0.0))
    return torch.matmul(weights, value).transpose(1, 2).contiguous(), None


def products_mask(*args: Any, dtype: torch.dtype, **settings: Any) -> Tensor | None:
    """Return the mask to add to the scores, in bf16 even if the embeddings are fp32: the smallest
    fp32 number is infinite in bf16, and the softmax of rows of padding would be NaN."""
    return eager_mask(*args, dtype=torch.bfloat16, **settings)


def attend_by_frame(
    module: Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Any, **settings: Any
) -> tuple[Tensor, None]:
    """Attend among the (1, H, N, D) patches of several frames, each within its frame; return
    (1, N, H, D). Of the settings, `cu_seq_lens_q` has the bounds of the frames among the patches,
    and `max_length_q` the patches of the largest one."""
    bounds, largest = settings["cu_seq_lens_q"], settings["max_length_q"]
    reduced = torch.is_autocast_enabled(query.device.type) or query.dtype != torch.float32
    attend = attend_by_products if reduced and not query.is_cuda else sdpa_attention_forward
    settings = {name: settings.get(name, 0.0) for name in ("scaling", "dropout")}
    settings["is_causal"] = False
    parts = (query, key, value)
    frames = len(bounds) - 1
    if frames * largest == query.shape[2]:
        folded = (p[0].unflatten(1, (frames, largest)).transpose(0, 1) for p in parts)
        attended, _weights = attend(module, *folded, None, **settings)
        return attended.flatten(0, 1)[None], None
    split = zip(*(p.split(bounds.diff().tolist(), dim=2) for p in parts), strict=True)
    return torch.cat([attend(module, *one, None, **settings)[0] for one in split], dim=1), None


AttentionInterface.register(PRODUCTS, attend_by_products)
AttentionMaskInterface.register(PRODUCTS, products_mask)
AttentionInterface.register(BY_FRAME, attend_by_frame)
