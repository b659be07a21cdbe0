"""The optimizer Muon."""

from __future__ import annotations

import pytest
import torch
from torch.linalg import qr, svdvals

from research.tiny_base.muon import Muon, orthogonalize


@pytest.mark.parametrize("shape", [(12, 12), (8, 30), (30, 8)])
def test_singular_values_become_about_1(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    values = svdvals(orthogonalize(torch.randn(shape)))
    assert values.min() > 0.5
    assert values.max() < 1.25


def test_orthogonalization_keeps_singular_vectors() -> None:
    """It commutes with rotations and does not depend on the scale."""
    torch.manual_seed(0)
    matrix = torch.randn(6, 20)
    left, right = (qr(torch.randn(n, n)).Q for n in matrix.shape)
    expected = left @ orthogonalize(matrix) @ right
    torch.testing.assert_close(orthogonalize(left @ matrix @ right), expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(orthogonalize(1e3 * matrix), orthogonalize(matrix))
    torch.testing.assert_close(orthogonalize(matrix.T), orthogonalize(matrix).T)
    assert not orthogonalize(torch.zeros(3, 4)).any()


def test_steps_are_those_of_torch() -> None:
    """PyTorch computes the same updates in bf16."""
    torch.manual_seed(0)
    start = torch.randn(10, 16)
    ours, theirs = (torch.nn.Parameter(start.clone()) for _ in range(2))
    settings = {"lr": 0.05, "weight_decay": 0.1}
    optimizers = (
        Muon([ours], **settings),
        torch.optim.Muon([theirs], adjust_lr_fn="match_rms_adamw", **settings),
    )
    for _ in range(5):
        gradient = torch.randn_like(start)
        for weight, optimizer in zip((ours, theirs), optimizers, strict=True):
            weight.grad = gradient.clone()
            optimizer.step()
    moved = (ours - start).norm()
    assert (ours - theirs).norm() < 0.05 * moved


def test_matrices_without_gradient_do_not_change() -> None:
    weight = torch.nn.Parameter(torch.ones(2, 3))
    Muon([weight], weight_decay=0.5).step()
    assert (weight == 1).all()
