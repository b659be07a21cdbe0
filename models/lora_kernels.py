"""The same passes in fewer and faster operations, for a model that is trained.

Patches do not overlap: the convolution over them is one matrix product, which is several times as
fast, the more so backwards. And what an adapter gives is scaled while it is as narrow as its rank,
and added in place to what it is laid over, within the product that widens it. peft scales and adds
in passes over the whole width and keeps what lies between; what a layer in 4 bits gives it copies
first, for adapters that change a view of it.
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
    """Let a Qwen3-VL with or without adapters compute so, in place. Its parameters, their names and
    what is saved of them stay as they are."""
    for module in list(model.modules()):
        # Released checkpoints name what embeds patches so, in every Qwen-VL since the second.
        embeds = getattr(module, "patch_embed", None)
        if isinstance(getattr(embeds, "proj", None), nn.Conv3d):
            embeds.proj.__class__ = PatchProduct
        if type(module) in ROWS:
            module.__class__ = ROWS[type(module)]
            for name in set(module.lora_A) - set(module.lora_variant):
                module.lora_variant[name] = AddedInPlace()


def unfuse(model: nn.Module) -> None:
    """Let a model compute as it did before `fuse`, in place."""
    for module in list(model.modules()):
        if isinstance(module, PatchProduct):
            module.__class__ = nn.Conv3d
        if type(module) in ROWS.values():
            for name, variant in list(module.lora_variant.items()):
                if isinstance(variant, AddedInPlace):
                    del module.lora_variant[name]
            module.__class__ = type(module).__base__


class PatchProduct(nn.Conv3d):
    """A convolution that is given patches of the size of its kernel: (N, C, T, H, W) become
    (N, channels, 1, 1, 1)."""

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        # A model of one's own may give it whole clips.
        if patches.shape[2:] != self.kernel_size:
            return super().forward(patches)
        found = linear(patches.flatten(1), self.weight.flatten(1), self.bias)
        return found[..., None, None, None]


class AddedInPlace(LoraVariant):
    """Plain LoRA over rows, for `peft`'s forward alone: merging is left to models that are loaded
    for it."""

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
    """Adapters over a layer that is given rows: what it gives is then no view, and autograd lets it
    be changed in place at no cost."""

    def forward(self, x: torch.Tensor, *args: Any, **settings: Any) -> torch.Tensor:
        rows = super().forward(x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])


class RowsLinear4bit(Linear4bit):
    """The same over a layer in 4 bits, by the forward of any other layer, which copies nothing."""

    def forward(self, x: torch.Tensor, *args: Any, **settings: Any) -> torch.Tensor:
        rows = Linear.forward(self, x.flatten(0, -2), *args, **settings)
        return rows.unflatten(0, x.shape[:-1])

    def _cast_input_dtype(self, x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        # Autocast would only cast it back.
        enabled = torch.is_autocast_enabled(x.device.type)
        return x if enabled else super()._cast_input_dtype(x, dtype)


ROWS = {Linear: RowsLinear, Linear4bit: RowsLinear4bit}
