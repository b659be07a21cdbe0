"""The precision of a model's forward and backward passes."""

from __future__ import annotations


def resolve_precision(precision: str, *, on_cpu: bool = False) -> str:
    """Resolve auto to bf16 or fp32; return bf16 and fp32 unchanged.

    auto is bf16 if the GPU or CPU has instructions for bf16. A CPU without them takes several times
    as long in bf16 as in fp32.

    Args:
        on_cpu: Whether the model computes on the CPU even if there is a GPU.
    """
    if precision != "auto":
        return precision
    return "bf16" if supports_bf16(on_cpu) else "fp32"


def supports_bf16(on_cpu: bool = False) -> bool:
    import torch

    if torch.cuda.is_available() and not on_cpu:
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return any(has for name, has in torch.cpu.get_capabilities().items() if "bf16" in name)
