"""Choose the fastest attention for Qwen3-VL on this machine.

Up to rounding, the results are those of transformers.

In the vision tower, patches attend to the patches of the same image or of the same pair of a clip's
frames, both called a frame below. Without flash attention, transformers computes the attention in
one call per frame; here, one batched call computes it for all frames of one size.

On a CPU, the forward and backward pass of torch's fused attention takes 1.5 times as long as matrix
products of blocks of queries with the keys before them; in bf16, three times as long. The products
are used for up to `MATMUL_MAX_TOKENS` tokens.
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

MATMUL = "dynapix_products"
BY_FRAME = "dynapix_frames_flash"
"""The name must contain "flash". Otherwise Qwen3-VL's vision tower calls the function once per
frame, instead of once for all frames with their bounds."""
MATMUL_MAX_TOKENS = 2048
"""Maximum number of tokens for attention by matrix products, which keeps the scores of all pairs of
tokens for the backward pass."""
MATMUL_BLOCK = 128
"""Number of queries whose scores are computed together. They attend to the same keys or fewer."""


def choose_attention(model: PreTrainedModel, precision: str, max_length: int) -> None:
    """Set a Qwen3-VL's attention to the fastest implementation for this machine, for computations
    in `precision` (bf16 or fp32) with up to `max_length` tokens. Other models are left unchanged.
    """
    if model.config.model_type != "qwen3_vl":
        return
    flash = flash_attention(precision)
    if flash is not None:
        model.set_attn_implementation(flash)
        return
    on_cpu = not torch.cuda.is_available()
    use_matmul = on_cpu and max_length <= MATMUL_MAX_TOKENS
    text = MATMUL if use_matmul else "sdpa"
    model.set_attn_implementation({"text_config": text, "vision_config": BY_FRAME})


def flash_attention(precision: str) -> str | None:
    """Return transformers' name of the installed flash attention, or None if none can be used."""
    if not torch.cuda.is_available() or precision != "bf16":
        return None
    if is_flash_attn_3_available():
        return "flash_attention_3"
    return "flash_attention_2" if is_flash_attn_2_available() else None


def attend_by_matmul(
    module: Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Any, **settings: Any
) -> tuple[Tensor, None]:
    """Compute attention by matrix products, from (B, H, Q, D) queries to (B, G, K, D) keys and
    values, where H is a multiple of G. Return (B, Q, H, D).

    Transformers' eager attention keeps the softmax of the scores twice for the backward pass, in
    fp32 and in bf16. This function keeps only the latter, which takes a third of the memory.

    Args:
        attention_mask: (B, 1, Q, K) mask to add to the scores, which masks at least all later keys
            of each query; None for bidirectional attention.
    """
    repeats = query.shape[1] // key.shape[1]
    query, key = query * settings["scaling"], repeat_kv(key, repeats).transpose(2, 3)
    value = repeat_kv(value, repeats)
    rate = settings.get("dropout", 0.0)
    if attention_mask is None:
        weights = dropout((query @ key).softmax(dim=-1), rate)
        return (weights @ value).transpose(1, 2).contiguous(), None
    parts, earlier = [], key.shape[3] - query.shape[2]
    for start in range(0, query.shape[2], MATMUL_BLOCK):
        rows = slice(start, start + MATMUL_BLOCK)
        seen = slice(0, earlier + min(start + MATMUL_BLOCK, query.shape[2]))
        scores = query[:, :, rows] @ key[..., seen]
        scores.add_(attention_mask[:, :, rows, seen])
        parts.append(dropout(scores.softmax(dim=-1), rate) @ value[:, :, seen])
    return torch.cat(parts, dim=2).transpose(1, 2).contiguous(), None


def matmul_mask(*args: Any, dtype: torch.dtype, **settings: Any) -> Tensor | None:
    """Return the mask to add to the scores, in bf16 even if the embeddings are fp32: in bf16, the
    lowest fp32 number is -inf, and the softmax of a row that is masked entirely would be NaN."""
    return eager_mask(*args, dtype=torch.bfloat16, **settings)


def attend_by_frame(
    module: Module, query: Tensor, key: Tensor, value: Tensor, attention_mask: Any, **settings: Any
) -> tuple[Tensor, None]:
    """Compute attention within each of several frames, for (1, H, N, D) queries, keys and values of
    all their N patches. Return (1, N, H, D).

    `cu_seq_lens_q` has the index of each frame's first patch, and N; `max_length_q` is the number
    of patches of the largest frame.
    """
    bounds, largest = settings["cu_seq_lens_q"], settings["max_length_q"]
    reduced = torch.is_autocast_enabled(query.device.type) or query.dtype != torch.float32
    attend = attend_by_matmul if reduced and not query.is_cuda else sdpa_attention_forward
    settings = {name: settings.get(name, 0.0) for name in ("scaling", "dropout")}
    settings["is_causal"] = False
    parts = (query, key, value)
    frames = len(bounds) - 1
    if frames * largest == query.shape[2]:
        folded = (p[0].unflatten(1, (frames, largest)).transpose(0, 1) for p in parts)
        attended, _weights = attend(module, *folded, None, **settings)
        return attended.flatten(0, 1)[None], None
    split = zip(*(p.split(bounds.diff().tolist(), dim=2) for p in parts), strict=True)
    return torch.cat([attend(module, *frame, None, **settings)[0] for frame in split], dim=1), None


AttentionInterface.register(MATMUL, attend_by_matmul)
AttentionMaskInterface.register(MATMUL, matmul_mask)
AttentionInterface.register(BY_FRAME, attend_by_frame)
