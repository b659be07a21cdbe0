"""Sample tokens with one seed per response.

A response then depends on its seed only, not on the other responses of its batch or on where a
killed command resumed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from transformers import (
    LogitsProcessor,
    LogitsProcessorList,
    TemperatureLogitsWarper,
    TopKLogitsWarper,
    TopPLogitsWarper,
)

from conf.schema import StudentConfig


def sampling_processors(cfg: StudentConfig, seeds: Sequence[int]) -> LogitsProcessorList:
    """Return logits processors that make greedy decoding sample, each row with its own seed; none
    at temperature 0."""
    steps = LogitsProcessorList()
    if cfg.temperature:
        steps.append(TemperatureLogitsWarper(float(cfg.temperature)))
        if cfg.top_k:
            steps.append(TopKLogitsWarper(cfg.top_k))
        if cfg.top_p < 1:
            steps.append(TopPLogitsWarper(float(cfg.top_p)))
        steps.append(GumbelNoise(seeds))
    return steps


class GumbelNoise(LogitsProcessor):
    """Adds Gumbel noise to the logits (B, V): the argmax is then a sample from their softmax."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self._seeds = seeds
        self._generators: list[torch.Generator] | None = None

    def __call__(self, input_ids: torch.LongTensor, scores: torch.FloatTensor) -> torch.FloatTensor:
        if self._generators is None:
            # The device is not known earlier.
            self._generators = [
                torch.Generator(scores.device).manual_seed(seed) for seed in self._seeds
            ]
        noise = torch.empty_like(scores)
        for row, generator in zip(noise, self._generators, strict=True):
            row.exponential_(generator=generator)
        return scores - noise.clamp_min(torch.finfo(noise.dtype).tiny).log()
