"""Draws a model's tokens so that an answer is a function of its own seed, whichever answers are
written beside it and however often a command is killed."""

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
    """What makes greedy decoding draw as `cfg` says, each row by its own seed; nothing where the
    temperature is 0."""
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
    """Adds Gumbel noise to the logits (B, V): the greatest sum is a draw from their softmax."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self._seeds = seeds
        self._generators: list[torch.Generator] | None = None

    def __call__(self, input_ids: torch.LongTensor, scores: torch.FloatTensor) -> torch.FloatTensor:
        if self._generators is None:
            # The device is known only here.
            self._generators = [
                torch.Generator(scores.device).manual_seed(seed) for seed in self._seeds
            ]
        noise = torch.empty_like(scores)
        for row, generator in zip(noise, self._generators, strict=True):
            row.exponential_(generator=generator)
        return scores - noise.clamp_min(torch.finfo(noise.dtype).tiny).log()
