"""The optimizer Muon."""

from __future__ import annotations

import pytest
import torch
from torch.linalg import svdvals

from research.tiny_base.muon import Muon, orthogonalize


@pytest.mark.parametrize("shape", [(12, 12), (8, 30), (30, 8)])
def test_steps_are_those_of_torch(shape: tuple[int, int]) -> None:
    """PyTorch computes the same updates in bf16. All singular values of an update are about 1."""
    torch.manual_seed(0)
    values = svdvals(orthogonalize(torch.randn(shape)))
    assert values.min() > 0.5
    assert values.max() < 1.25
    start = torch.randn(shape)
    ours, theirs, still = (torch.nn.Parameter(start.clone()) for _ in range(3))
    settings = {"lr": 0.05, "weight_decay": 0.1}
    optimizers = (
        Muon([ours, still], **settings),
        torch.optim.Muon([theirs], adjust_lr_fn="match_rms_adamw", **settings),
    )
    for _ in range(5):
        gradient = torch.randn_like(start)
        for weight, optimizer in zip((ours, theirs), optimizers, strict=True):
            weight.grad = gradient.clone()
            optimizer.step()
    moved = (ours - start).norm()
    assert (ours - theirs).norm() < 0.05 * moved
    # A matrix without gradient does not change.
    assert still.equal(start)
    assert not orthogonalize(torch.zeros(3, 4)).any()
