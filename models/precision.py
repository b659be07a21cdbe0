"""The precision of a model's passes."""

from __future__ import annotations

import torch


def resolve_precision(precision: str) -> str:
    """Return bf16 or fp32 for bf16, fp32 or auto.

    auto is bf16 where this machine has instructions for it: a CPU without them takes several times
    as long in bf16 as in fp32.
    """
    if precision != "auto":
        return precision
    return "bf16" if supports_bf16() else "fp32"


def supports_bf16() -> bool:
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return any(has for name, has in torch.cpu.get_capabilities().items() if "bf16" in name)
