"""Divergences: closed forms, limits, and gradients against an exact expectation."""

from __future__ import annotations

import math
from itertools import product

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


@pytest.mark.parametrize("beta", [0, 0.3, 1])
def test_equal_distributions_have_no_divergence(beta: float) -> None:
    logits = torch.randn(5, 7, dtype=torch.float64, requires_grad=True)
    same = log_softmax(logits, dim=-1)
    divergence = measure_divergence(same, same.detach(), beta)
    torch.testing.assert_close(divergence, torch.zeros(5, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(divergence.sum(), logits)
    torch.testing.assert_close(gradient, torch.zeros_like(gradient))


@pytest.mark.parametrize("beta", [0, 0.4, 1])
def test_gradient_is_that_of_the_expectation_over_sequences(beta: float) -> None:
    """The mean gradient over all sequences of three tokens, each with its probability, is that of
    the expected divergence at all prefixes, whose probabilities are constants."""
    torch.manual_seed(0)
    tokens, length = 2, 3
    prefixes = [p for n in range(length) for p in product(range(tokens), repeat=n)]
    logits = torch.randn(len(prefixes), tokens, dtype=torch.float64, requires_grad=True)
    teacher = log_softmax(torch.randn(len(prefixes), tokens, dtype=torch.float64), dim=-1)
    student = log_softmax(logits, dim=-1)
    at = {prefix: k for k, prefix in enumerate(prefixes)}

    def probability(sequence: tuple[int, ...]) -> torch.Tensor:
        steps = [student[at[sequence[:k]], token] for k, token in enumerate(sequence)]
        return torch.stack([*steps, torch.zeros((), dtype=torch.float64)]).sum().exp().detach()

    sampled = 0.0
    for sequence in product(range(tokens), repeat=length):
        rows = [at[sequence[:k]] for k in range(length)]
        loss = measure_divergence(student[rows], teacher[rows], beta).sum()
        (gradient,) = torch.autograd.grad(loss, logits, retain_graph=True)
        sampled = sampled + probability(sequence) * gradient
    weights = torch.stack([probability(prefix) for prefix in prefixes])
    exact = (weights * measure_divergence(student, teacher, beta)).sum()
    torch.testing.assert_close(sampled, torch.autograd.grad(exact, logits)[0])


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
