"""The same passes in fewer and faster operations, for a model that is trained.

Patches do not overlap: the convolution over them is one matrix product, which is several times as
fast, the more so backwards. What an adapter gives is scaled while it is as narrow as its rank, and
added to what it is laid over within the product that widens it; peft scales and adds in passes over
the whole width, and keeps what lies between. And what a layer in 4 bits gives is not copied first:
peft does that for adapters that would write into it, and these do not.
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
        if isinstance(module, LoraLayer) and not isinstance(module.get_base_layer(), nn.Embedding):
            for name in set(module.lora_A) - set(module.lora_variant):
                module.lora_variant[name] = AddedInProduct()
            if type(module) is Linear4bit:
                module.__class__ = UncopiedLinear4bit


def unfuse(model: nn.Module) -> None:
    """Let a model compute as it did before `fuse`, in place."""
    for module in list(model.modules()):
        if isinstance(module, PatchProduct):
            module.__class__ = nn.Conv3d
        if isinstance(module, LoraLayer):
            for name, variant in list(module.lora_variant.items()):
                if isinstance(variant, AddedInProduct):
                    del module.lora_variant[name]
        if isinstance(module, UncopiedLinear4bit):
            module.__class__ = Linear4bit


class PatchProduct(nn.Conv3d):
    """A convolution that is given patches of the size of its kernel: (N, C, T, H, W) become
    (N, channels, 1, 1, 1)."""

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        found = linear(patches.flatten(1), self.weight.flatten(1), self.bias)
        return found[..., None, None, None]


class AddedInProduct(LoraVariant):
    """Plain LoRA, for `peft`'s forward alone: merging is left to models that are loaded for it."""

    @staticmethod
    def forward(
        module: LoraLayer, active_adapter: str, x: torch.Tensor, result: torch.Tensor, **_: Any
    ) -> torch.Tensor:
        dropped = module.lora_dropout[active_adapter](x)
        narrow = module.lora_A[active_adapter](dropped) * module.scaling[active_adapter]
        # Without autocast the base may be in bf16 beside adapters in fp32.
        base, widening = result.to(narrow.dtype), module.lora_B[active_adapter].weight.T
        added = torch.addmm(base.flatten(0, -2), narrow.flatten(0, -2), widening.to(narrow.dtype))
        return added.view(result.shape)


class UncopiedLinear4bit(Linear4bit):
    """Adapters over a layer in 4 bits, which pass forward as those over any other layer."""

    forward = Linear.forward

    def _cast_input_dtype(self, x: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        # Autocast would only cast it back.
        enabled = torch.is_autocast_enabled(x.device.type)
        return x if enabled else super()._cast_input_dtype(x, dtype)
