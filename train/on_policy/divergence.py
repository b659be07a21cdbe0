"""Divergences of a student's distributions over tokens from a teacher's."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def measure_divergence(student: Tensor, teacher: Tensor, beta: float) -> Tensor:
    """Return the generalised Jensen-Shannon divergence (N,) of distributions over V tokens.

    With the mixture M = beta T + (1 - beta) S, it is beta KL(T || M) + (1 - beta) KL(S || M)
    (Agarwal et al. 2024, "On-Policy Distillation of Language Models"). It is zero for
    beta 0 and 1. There, the function returns the limits of its ratios to beta and to 1 - beta:
    KL(T || S) for beta 0, and KL(S || T) for beta 1.

    Args:
        student: (N, V) logarithms of the student's probabilities S.
        teacher: (N, V) logarithms of the teacher's probabilities T.
    """
    if beta == 0:
        return kl_divergence(teacher, student)
    if beta == 1:
        return kl_divergence(student, teacher)
    mixture = torch.logaddexp(teacher + math.log(beta), student + math.log(1 - beta))
    return beta * kl_divergence(teacher, mixture) + (1 - beta) * kl_divergence(student, mixture)


def kl_divergence(log_p: Tensor, log_q: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence KL(p || q) (N,) of distributions (N, V), given as
    logarithms."""
    return (log_p.exp() * (log_p - log_q)).sum(dim=-1)


def estimate_divergence(student: Tensor, teacher: Tensor) -> Tensor:
    """Return estimates (N,) of the reverse Kullback-Leibler divergence KL(S || T) from one token
    each that was sampled from S. Over the tokens of S, the means of an estimate and of its gradient
    are the divergence and its gradient.

    Args:
        student: (N,) logarithms of the student's probabilities S of the tokens.
        teacher: (N,) logarithms of the teacher's probabilities T of the tokens.
    """
    difference = (student - teacher).detach()
    # The second term is 0. Its gradient is that of log S, weighted by the difference.
    return difference + difference * (student - student.detach())
