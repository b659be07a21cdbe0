"""Faster layers for training a Qwen3-VL. Up to rounding, they give the same results.

- The convolution over patches, which do not overlap, is one matrix product: several times as fast.
- Adapters scale B's weights, and add the product of A's narrow output with them in place to the
  base layer's output. peft scales and adds B's wide output, keeps the intermediate results, and
  first copies the output of a 4-bit layer.
- The start that samples of a batch share is computed once (see `models.layers.shared_prompts`).
- Frozen norms, and the rotation of normed queries and keys by their positions, have their own
  gradients. Autograd reads and writes twice as many tensors of the size of the input.
"""

from __future__ import annotations

from typing import Any

import torch
from peft.tuners.lora import LoraLayer
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear, LoraVariant
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS
from transformers.models.qwen3_vl.modeling_qwen3_vl import (
    Qwen3VLTextAttention,
    Qwen3VLTextModel,
    Qwen3VLTextRMSNorm,
    apply_rotary_pos_emb,
    eager_attention_forward,
)

from dynapix.models.layers.shared_prompts import SharedPromptTower


def use_fast_layers(model: nn.Module) -> None:
    """Replace layers of a model, with or without adapters, in place. Parameters, their names and
    saved files do not change."""
    for module in list(model.modules()):
        if fused := FUSED.get(type(module)):
            module.__class__ = fused
            if isinstance(module, LoraLayer):
                for name in set(module.lora_A) - set(module.lora_variant):
                    module.lora_variant[name] = AddedInPlace()


class PatchProduct(nn.Conv3d):
    """A convolution over patches of the size of its kernel: (N, C, T, H, W) to
    (N, channels, 1, 1, 1)."""

    def forward(self, patches: Tensor) -> Tensor:
        # In other models, a convolution may have larger inputs than its kernel.
        if patches.shape[2:] != self.kernel_size or any(self.padding) or self.groups > 1:
            return super().forward(patches)
        embedded = linear(patches.flatten(1), self.weight.flatten(1), self.bias)
        return embedded[..., None, None, None]


class AddedInPlace(LoraVariant):
    """Plain LoRA for (rows, features), added to `result` in place. It cannot merge: models are
    loaded without it for merging."""

    @staticmethod
    def forward(
        module: LoraLayer, active_adapter: str, x: Tensor, result: Tensor, **_: Any
    ) -> Tensor:
        narrow = module.lora_A[active_adapter](module.lora_dropout[active_adapter](x))
        scaled = module.lora_B[active_adapter].weight.T * module.scaling[active_adapter]
        # Without autocast, the base may be in bf16 and its adapters in fp32.
        return result.to(narrow.dtype).addmm_(narrow, scaled.to(narrow.dtype))


class Rows:
    """Mixin for a linear layer with adapters that flattens its input to (rows, features): the base
    layer's output is then not a view, and autograd allows changing it in place without a copy."""

    def forward(self, x: Tensor, *args: Any, **settings: Any) -> Tensor:
        # Unlike that of 4-bit layers, the `forward` of unquantised layers copies nothing.
        rows = Linear.forward(self, x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])

    def _cast_input_dtype(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        # Autocast would undo the cast to the adapters' type, and each layer would keep a copy.
        enabled = torch.is_autocast_enabled(x.device.type)
        return x if enabled else super()._cast_input_dtype(x, dtype)


class RowsLinear(Rows, Linear):
    """An unquantised layer."""


class RowsLinear4bit(Rows, Linear4bit):
    """A 4-bit layer."""


class FrozenNorm(Qwen3VLTextRMSNorm):
    """A root mean square norm with its own gradient, unless its weight is trained."""

    def forward(self, hidden_states: Tensor) -> Tensor:
        if self.weight.requires_grad:
            return super().forward(hidden_states)
        return Normed.apply(hidden_states, self.weight, self.variance_epsilon)


class Normed(torch.autograd.Function):
    """A root mean square norm with a constant weight, computed in fp32."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, epsilon: float) -> Tensor:
        unit, factor = normalize(x, epsilon)
        ctx.save_for_backward(unit.to(x.dtype), factor, weight)
        return unit.mul(weight).to(x.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        unit, factor, weight = ctx.saved_tensors
        return normalize_backward(gradient.float() * weight, unit, factor), None, None


class NormedRotation(torch.autograd.Function):
    """The rotation of normed heads by their positions, with a constant weight of the norm: of x
    (B, L, H, D) by cosines and sines (B, L, D), whose first and second half of D are equal."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, weight: Tensor, epsilon: float, cos: Tensor, sin: Tensor
    ) -> Tensor:
        unit, factor = normalize(x, epsilon)
        # The result is unit * straight + swap(unit) * crossed, where swap exchanges the halves.
        one, two = weight.float().chunk(2)
        straight = (cos * weight).unsqueeze(2).float()
        crossed = (sin * torch.cat([-two, one])).unsqueeze(2).float()
        ctx.save_for_backward(unit.to(x.dtype), factor, straight, crossed)
        return (unit * straight).addcmul_(swap_halves(unit), crossed).to(x.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        unit, factor, straight, crossed = ctx.saved_tensors
        gradient = gradient.float()
        of_unit = gradient * straight
        of_unit += swap_halves(gradient * crossed)
        return normalize_backward(of_unit, unit, factor), None, None, None, None


def normalize(x: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """Return x divided by its root mean square over the last dimension, and the factor, in fp32."""
    x = x.float()
    mean = torch.linalg.vecdot(x, x).div_(x.shape[-1])
    factor = mean.add_(epsilon).rsqrt_().unsqueeze(-1)
    return x * factor, factor


def normalize_backward(of_unit: Tensor, unit: Tensor, factor: Tensor) -> Tensor:
    """Return the gradient of x from that of `normalize`'s first result, in the type of `unit`."""
    along = torch.linalg.vecdot(of_unit, unit.float()).div_(unit.shape[-1]).unsqueeze(-1)
    return of_unit.addcmul_(unit, along, value=-1).mul_(factor).to(unit.dtype)


def swap_halves(x: Tensor) -> Tensor:
    return torch.cat(x.chunk(2, -1)[::-1], dim=-1)


class FastAttention(Qwen3VLTextAttention):
    """Attention that rotates queries and keys with `NormedRotation`, if their norms are frozen.

    Attributes:
        last_only: Whether to attend from the last token only: the result is then (B, 1, width).
    """

    last_only = False

    def forward(
        self,
        hidden_states: Tensor,
        position_embeddings: tuple[Tensor, Tensor],
        attention_mask: Tensor | None,
        past_key_values: Any = None,
        **settings: Any,
    ) -> tuple[Tensor, None]:
        tokens = slice(-1 if self.last_only else None, None)
        own_positions = [each[:, tokens] for each in position_embeddings]
        query = self._rotate(self.q_norm, self.q_proj(hidden_states[:, tokens]), *own_positions)
        key = self._rotate(self.k_norm, self.k_proj(hidden_states), *position_embeddings)
        value = self._heads(self.v_proj(hidden_states)).transpose(1, 2)
        if past_key_values is not None:
            key, value = past_key_values.update(key, value, self.layer_idx)
        if attention_mask is not None and attention_mask.ndim == 4:
            attention_mask = attention_mask[:, :, tokens]
        attend = ALL_ATTENTION_FUNCTIONS.get_interface(
            self.config._attn_implementation, eager_attention_forward
        )
        # The text tower of Qwen3-VL has no dropout of attention weights.
        attended, _weights = attend(
            self, query, key, value, attention_mask, scaling=self.scaling, dropout=0.0, **settings
        )
        return self.o_proj(attended.flatten(2)), None

    def _heads(self, projected: Tensor) -> Tensor:
        return projected.unflatten(-1, (-1, self.head_dim))

    def _rotate(
        self, norm: Qwen3VLTextRMSNorm, projected: Tensor, cos: Tensor, sin: Tensor
    ) -> Tensor:
        """Return rotated heads (B, H, L, D) of a projection (B, L, H * D)."""
        heads = self._heads(projected)
        if norm.weight.requires_grad:
            normed = norm(heads).transpose(1, 2)
            return apply_rotary_pos_emb(normed, normed, cos, sin)[0]
        epsilon = norm.variance_epsilon
        return NormedRotation.apply(heads, norm.weight, epsilon, cos, sin).transpose(1, 2)


FUSED = {
    nn.Conv3d: PatchProduct,
    Linear: RowsLinear,
    Linear4bit: RowsLinear4bit,
    Qwen3VLTextRMSNorm: FrozenNorm,
    Qwen3VLTextAttention: FastAttention,
    Qwen3VLTextModel: SharedPromptTower,
}
