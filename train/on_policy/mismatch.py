"""How far a sampler's probabilities of the tokens that it sampled are from the trainer's.

They differ by rounding, and more if the sampler is a server whose base has another precision. A
step whose responses another distribution sampled has a biased gradient.
"""

from __future__ import annotations

import torch
from accelerate import Accelerator
from torch import Tensor

LARGEST_EXPONENT = 20.0
"""Largest logarithm of a ratio in the mean: a server may give a token the log-probability -9999."""


class Mismatch:
    """Collects the differences of log-probabilities, trainer's minus sampler's, of sampled tokens.

    Args:
        cap: Largest ratio of the probabilities that is not truncated; None truncates none.
    """

    def __init__(self, cap: float | None = None) -> None:
        self._cap = cap
        self._differences: list[Tensor] = []

    def add(self, differences: Tensor) -> None:
        """Add the differences (N,) of a micro-batch."""
        self._differences.append(differences.detach().float())

    def take(self, accelerator: Accelerator) -> dict[str, float]:
        """Return the measures over the tokens of all ranks since the last call; empty without
        tokens."""
        found = torch.cat([torch.zeros(0, device=accelerator.device), *self._differences])
        self._differences = []
        ratios = found.clamp(max=LARGEST_EXPONENT).exp()
        capped = ratios > (torch.inf if self._cap is None else self._cap)
        sums = torch.stack([found.abs().sum(), ratios.sum(), capped.float().sum()])
        count = torch.tensor([len(found)], dtype=torch.float32, device=accelerator.device)
        count, distance, ratio, truncated = accelerator.reduce(torch.cat([count, sums])).tolist()
        largest = torch.cat([found.abs(), torch.zeros(1, device=accelerator.device)]).max()
        largest = accelerator.gather(largest[None]).max().item()
        if not count:
            return {}
        measures = {
            "mismatch_mean": distance / count,
            "mismatch_max": largest,
            "mismatch_ratio": ratio / count,
        }
        return measures if self._cap is None else {**measures, "mismatch_capped": truncated / count}
