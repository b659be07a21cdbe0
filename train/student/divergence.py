"""Divergences of a student's distributions over tokens from a teacher's."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def measure_divergence(student: Tensor, teacher: Tensor, weight: float) -> Tensor:
    """Return the generalised Jensen-Shannon divergence (N,) of distributions over V tokens.

    With the mixture M = w T + (1 - w) S, it is w KL(T || M) + (1 - w) KL(S || M) (Agarwal et al.
    2024, "On-Policy Distillation of Language Models"). This vanishes as w approaches 0 or 1, where
    the limit of its ratio to w or 1 - w is taken: KL(T || S) for w = 0, and KL(S || T) for w = 1.

    Args:
        student: (N, V) logarithms of the student's probabilities S.
        teacher: (N, V) logarithms of the teacher's probabilities T.
        weight: The weight w of the teacher, from 0 to 1.
    """
    if weight == 0:
        return measure_kl(teacher, student)
    if weight == 1:
        return measure_kl(student, teacher)
    mixture = torch.logaddexp(teacher + math.log(weight), student + math.log(1 - weight))
    return weight * measure_kl(teacher, mixture) + (1 - weight) * measure_kl(student, mixture)


def measure_kl(one: Tensor, other: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence (N,) of `one` from `other`, both (N, V) logarithms of
    probabilities. A token without probability in `one` adds nothing."""
    terms = one.exp() * (one - other)
    return torch.where(one == -torch.inf, 0.0, terms).sum(dim=-1)
