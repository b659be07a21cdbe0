"""Choose the fastest attention for Qwen3-VL on this machine.

Up to rounding, the results are those of transformers.

In the vision tower, patches attend to the patches of the same image or of the same pair of a clip's
frames, both called a frame below. Without flash attention, transformers computes the attention in
one call per frame; here, one batched call computes it for all frames of one size.

On a CPU, the forward and backward pass of torch's fused attention takes 1.3 to 1.5 times as long as
matrix products of blocks of queries with the keys before them; in bf16, three times as long. The
products are used for up to `MATMUL_MAX_TOKENS` tokens. In fp32 without AVX-512, the fused attention
is faster for fewer than `MATMUL_MIN_QUERIES` queries.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import Module
from transformers import AttentionInterface, AttentionMaskInterface, PreTrainedModel
from transformers.integrations.sdpa_attention import sdpa_attention_forward
from transformers.masking_utils import eager_mask
from transformers.utils import is_flash_attn_2_available, is_flash_attn_3_available

MATMUL = "dynapix_products"
BY_FRAME = "dynapix_frames_flash"
"""The name must contain "flash". Otherwise Qwen3-VL's vision tower calls the function once per
frame, instead of once for all frames with their bounds."""
MATMUL_MAX_TOKENS = 2048
"""Maximum number of tokens for attention by matrix products, which keeps the scores of all pairs of
tokens for the backward pass."""
MATMUL_MIN_QUERIES = 384
"""Minimum number of queries for the products in fp32 on a CPU without AVX-512."""
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
    text = MATMUL if on_cpu and max_length <= MATMUL_MAX_TOKENS else "sdpa"
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
    values, where H is a multiple of G. Return (B, Q, H, D). Torch's fused attention is used where
    it is faster and for dropout.

    Args:
        attention_mask: (B, 1, Q, K) mask to add to the scores, which masks at least all later keys
            of each query; None for bidirectional attention.
    """
    device = query.device.type
    if torch.is_autocast_enabled(device):
        dtype = torch.get_autocast_dtype(device)
        query, key, value = query.to(dtype), key.to(dtype), value.to(dtype)
    has_few_queries = query.dtype == torch.float32 and query.shape[2] < MATMUL_MIN_QUERIES
    fused_is_faster = has_few_queries and torch.backends.cpu.get_cpu_capability() != "AVX512"
    if settings.get("dropout") or fused_is_faster:
        mask = None if attention_mask is None else attention_mask.to(query.dtype)
        return sdpa_attention_forward(module, query, key, value, mask, **settings)
    return ProductAttention.apply(query, key, value, attention_mask, settings["scaling"]), None


class ProductAttention(torch.autograd.Function):
    """Attention by matrix products of blocks of queries with the keys that they can see.

    The backward pass adds up the gradients of keys and values in place. Autograd would fill a
    tensor of their full size for each block. Only the softmax of the scores is kept, in the type of
    the queries.
    """

    @staticmethod
    def forward(
        ctx: Any, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, scaling: float
    ) -> Tensor:
        (batch, heads, length, size), groups = query.shape, key.shape[1]
        keys, values = key.flatten(0, 1), value.flatten(0, 1)
        # Queries of heads with the same keys are the rows of one product.
        queries = query.unflatten(1, (groups, -1)) * scaling
        attended = query.new_empty(batch, length, heads, size)
        blocks, weights = seen_keys(length, keys.shape[1], mask is not None), []
        for rows, seen in blocks:
            block = queries[:, :, :, rows]
            scores = torch.bmm(block.flatten(2, 3).flatten(0, 1), keys[:, seen].mT)
            if mask is not None:
                scores.view(*block.shape[:-1], -1).add_(mask[:, None, :, rows, seen])
            weights.append(scores.softmax(dim=-1))
            found = torch.bmm(weights[-1], values[:, seen]).view(block.shape)
            attended[:, rows].unflatten(2, (groups, -1)).copy_(found.permute(0, 3, 1, 2, 4))
        ctx.save_for_backward(queries, keys, values, *weights)
        ctx.blocks, ctx.scaling = blocks, scaling
        return attended

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        queries, keys, values, *weights = ctx.saved_tensors
        of_queries = torch.empty_like(queries)
        of_keys, of_values = torch.zeros_like(keys), torch.zeros_like(values)
        gradient = gradient.unflatten(2, queries.shape[1:3]).permute(0, 2, 3, 1, 4)
        for (rows, seen), weight in zip(ctx.blocks, weights, strict=True):
            block = queries[:, :, :, rows]
            own = gradient[:, :, :, rows].flatten(2, 3).flatten(0, 1)
            of_values[:, seen].baddbmm_(weight.mT, own)
            of_weights = torch.bmm(own, values[:, seen].mT)
            of_scores = torch._softmax_backward_data(of_weights, weight, -1, weight.dtype)
            of_keys[:, seen].baddbmm_(of_scores.mT, block.flatten(2, 3).flatten(0, 1))
            found = torch.bmm(of_scores, keys[:, seen]).view(block.shape)
            of_queries[:, :, :, rows] = found.mul_(ctx.scaling)
        shape = queries.shape[0], -1, *keys.shape[1:]
        return of_queries.flatten(1, 2), of_keys.view(shape), of_values.view(shape), None, None


def seen_keys(queries: int, keys: int, is_causal: bool) -> list[tuple[slice, slice]]:
    """Return blocks of queries, and the keys that each block can see. The last queries are those of
    the last keys."""
    if not is_causal:
        return [(slice(queries), slice(keys))]
    starts = range(0, queries, MATMUL_BLOCK)
    rows = [slice(start, min(start + MATMUL_BLOCK, queries)) for start in starts]
    return [(row, slice(keys - queries + row.stop)) for row in rows]


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
