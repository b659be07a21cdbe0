"""Faster layers for training a Qwen3-VL. Up to rounding, they give the same results.

The convolution over patches, which do not overlap, is one matrix product: several times as fast.
Adapters scale B's weights, and add the product of A's narrow output with them in place to the base
layer's output. peft scales and adds B's wide output, keeps the intermediate results, and first
copies the output of a 4-bit layer.
"""

from __future__ import annotations

from typing import Any

import torch
from peft.tuners.lora import LoraLayer
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear, LoraVariant
from torch import nn
from torch.nn.functional import linear


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

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
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
        module: LoraLayer, active_adapter: str, x: torch.Tensor, result: torch.Tensor, **_: Any
    ) -> torch.Tensor:
        narrow = module.lora_A[active_adapter](module.lora_dropout[active_adapter](x))
        scaled = module.lora_B[active_adapter].weight.T * module.scaling[active_adapter]
        # Without autocast, the base may be in bf16 and its adapters in fp32.
        return result.to(narrow.dtype).addmm_(narrow, scaled.to(narrow.dtype))


class Rows:
    """Mixin for a linear layer with adapters that flattens its input to (rows, features): the base
    layer's output is then not a view, and autograd allows changing it in place without a copy."""

    def forward(self, x: torch.Tensor, *args: Any, **settings: Any) -> torch.Tensor:
        # Unlike that of 4-bit layers, the `forward` of unquantised layers copies nothing.
        rows = Linear.forward(self, x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])

    def _cast_input_dtype(self, x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        # Autocast would undo the cast to the adapters' type, and each layer would keep a copy.
        enabled = torch.is_autocast_enabled(x.device.type)
        return x if enabled else super()._cast_input_dtype(x, dtype)


class RowsLinear(Rows, Linear):
    """An unquantised layer."""


class RowsLinear4bit(Rows, Linear4bit):
    """A 4-bit layer."""


FUSED = {nn.Conv3d: PatchProduct, Linear: RowsLinear, Linear4bit: RowsLinear4bit}
