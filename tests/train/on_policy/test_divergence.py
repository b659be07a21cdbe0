"""Divergences: the closed form, and the mean of estimates and of their gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import log_softmax

from dynapix.train.on_policy.teachers import estimate_divergence, kl_divergence


@pytest.mark.parametrize(("s", "t"), [(0.3, 0.8), (0.9, 0.5), (0.01, 0.6)])
def test_two_tokens_have_the_closed_form(s: float, t: float) -> None:
    student, teacher = (torch.tensor([[p, 1 - p]], dtype=torch.float64).log() for p in (s, t))
    expected = s * math.log(s / t) + (1 - s) * math.log((1 - s) / (1 - t))
    assert kl_divergence(student, teacher).item() == pytest.approx(expected)


def test_estimates_have_the_mean_and_the_gradient_of_the_divergence() -> None:
    torch.manual_seed(1)
    logits = torch.randn(4, 5, dtype=torch.float64, requires_grad=True)
    teacher = log_softmax(torch.randn(4, 5, dtype=torch.float64), dim=-1)
    student = log_softmax(logits, dim=-1)
    exact = kl_divergence(student, teacher).sum()
    (gradient,) = torch.autograd.grad(exact, logits, retain_graph=True)
    weights = student.exp().detach()
    estimates = estimate_divergence(student.flatten(), teacher.flatten()).view(4, 5)
    mean = (weights * estimates).sum()
    torch.testing.assert_close(mean, exact)
    torch.testing.assert_close(torch.autograd.grad(mean, logits)[0], gradient)
