"""What a model computes in."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from conf.runs import rank, write_json

PRECISION = "precision.json"


def of_run(folder: Path, precision: str) -> str:
    """`settled` once for a run in `folder`, which notes it: on another machine too it goes on in
    what it was begun in."""
    note = folder / PRECISION
    if note.exists():
        return json.loads(note.read_text())
    found = resolve_precision(precision)
    if rank() == 0:
        write_json(note, found)
    return found


def resolve_precision(precision: str) -> str:
    """bf16 or fp32; `auto` is bf16 where this machine has instructions for it. A CPU without them
    takes several times as long as in fp32."""
    if precision != "auto":
        return precision
    return "bf16" if supports_bf16() else "fp32"


def supports_bf16() -> bool:
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return any(has for name, has in torch.cpu.get_capabilities().items() if "bf16" in name)
