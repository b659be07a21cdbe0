"""What is computed in follows the machine, where it is left to it."""

from __future__ import annotations

import pytest
import torch

from models.precision import resolve_precision


@pytest.mark.parametrize("named", ["bf16", "fp32"])
def test_a_named_precision_is_kept(named) -> None:
    assert resolve_precision(named) == named


@pytest.mark.parametrize(
    ("instructions", "expected"),
    [({"avx512_bf16": True, "avx2": True}, "bf16"), ({"amx_bf16": False, "avx2": True}, "fp32")],
)
def test_a_cpu_computes_in_what_it_has_instructions_for(
    monkeypatch, instructions, expected
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions)
    assert resolve_precision("auto") == expected
