"""What a model computes in."""

from __future__ import annotations

import torch


def settled(precision: str) -> str:
    """bf16 or fp32; `auto` is bf16 where this machine has instructions for it. A CPU without them
    takes several times as long as in fp32."""
    if precision != "auto":
        return precision
    return "bf16" if computes_bf16() else "fp32"


def computes_bf16() -> bool:
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return any(has for name, has in torch.cpu.get_capabilities().items() if "bf16" in name)
