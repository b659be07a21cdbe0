"""Faster operations with the same results, for a model in training.

Patches do not overlap, so the convolution over them is one matrix product, which is several times
as fast. The output of an adapter is scaled while it is as narrow as its rank, and added in place to
the base's output by the product that widens it. peft scales and adds over the whole width, keeps
the intermediate results, and copies the output of a 4-bit layer first.
"""

from __future__ import annotations

from typing import Any

import torch
from peft.tuners.lora import LoraLayer
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear, LoraVariant
from torch import nn
from torch.nn.functional import linear


def fuse(model: nn.Module) -> None:
    """Switch a Qwen3-VL, with or without adapters, to these operations in place. Parameters, their
    names and saved files do not change."""
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
        # A convolution of another model may take whole clips.
        if patches.shape[2:] != self.kernel_size or any(self.padding) or self.groups > 1:
            return super().forward(patches)
        embedded = linear(patches.flatten(1), self.weight.flatten(1), self.bias)
        return embedded[..., None, None, None]


class AddedInPlace(LoraVariant):
    """Plain LoRA over rows. It has only a forward: models are loaded without it for merging."""

    @staticmethod
    def forward(
        module: LoraLayer, active_adapter: str, x: torch.Tensor, result: torch.Tensor, **_: Any
    ) -> torch.Tensor:
        dropped = module.lora_dropout[active_adapter](x)
        narrow = module.lora_A[active_adapter](dropped) * module.scaling[active_adapter]
        widening = module.lora_B[active_adapter].weight.T
        # Without autocast the base may be in bf16 beside adapters in fp32.
        return result.to(narrow.dtype).addmm_(narrow, widening.to(narrow.dtype))


class RowsLinear(Linear):
    """Adapters over a layer whose input is flattened to rows: its output is then no view, and
    autograd lets it be changed in place at no cost."""

    def forward(self, x: torch.Tensor, *args: Any, **settings: Any) -> torch.Tensor:
        rows = super().forward(x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])


class RowsLinear4bit(Linear4bit):
    """The same for a 4-bit layer, with the forward of other layers, which copies nothing."""

    def forward(self, x: torch.Tensor, *args: Any, **settings: Any) -> torch.Tensor:
        rows = Linear.forward(self, x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])

    def _cast_input_dtype(self, x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        # Autocast would cast it back.
        enabled = torch.is_autocast_enabled(x.device.type)
        return x if enabled else super()._cast_input_dtype(x, dtype)


FUSED = {nn.Conv3d: PatchProduct, Linear: RowsLinear, Linear4bit: RowsLinear4bit}
