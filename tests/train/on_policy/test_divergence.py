"""Divergences: closed forms, limits, and gradients against an exact expectation."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import log_softmax

from dynapix.train.on_policy.divergence import estimate_divergence, measure_divergence


def binary(p: float) -> torch.Tensor:
    """The logarithms (1, 2) of the probabilities of two tokens."""
    return torch.tensor([[p, 1 - p]], dtype=torch.float64).log()


def kl(p: float, q: float) -> float:
    return p * math.log(p / q) + (1 - p) * math.log((1 - p) / (1 - q))


@pytest.mark.parametrize(("s", "t"), [(0.3, 0.8), (0.9, 0.5), (0.01, 0.6)])
def test_two_tokens_have_the_closed_form(s: float, t: float) -> None:
    assert measure_divergence(binary(s), binary(t), 1).item() == pytest.approx(kl(s, t))
    assert measure_divergence(binary(s), binary(t), 0).item() == pytest.approx(kl(t, s))
    for w in (0.1, 0.5, 0.9):
        m = w * t + (1 - w) * s
        expected = w * kl(t, m) + (1 - w) * kl(s, m)
        assert measure_divergence(binary(s), binary(t), w).item() == pytest.approx(expected)


def test_extreme_betas_are_limits() -> None:
    student, teacher = binary(0.3), binary(0.8)
    for w, limit in ((1e-6, 0), (1 - 1e-6, 1)):
        scaled = measure_divergence(student, teacher, w) / min(w, 1 - w)
        torch.testing.assert_close(
            scaled, measure_divergence(student, teacher, limit), rtol=1e-4, atol=0
        )


def test_estimates_have_the_mean_and_the_gradient_of_the_divergence() -> None:
    torch.manual_seed(1)
    logits = torch.randn(4, 5, dtype=torch.float64, requires_grad=True)
    teacher = log_softmax(torch.randn(4, 5, dtype=torch.float64), dim=-1)
    student = log_softmax(logits, dim=-1)
    exact = measure_divergence(student, teacher, 1).sum()
    (gradient,) = torch.autograd.grad(exact, logits, retain_graph=True)
    weights = student.exp().detach()
    estimates = estimate_divergence(student.flatten(), teacher.flatten()).view(4, 5)
    mean = (weights * estimates).sum()
    torch.testing.assert_close(mean, exact)
    torch.testing.assert_close(torch.autograd.grad(mean, logits)[0], gradient)
