"""Generate text with a model that is loaded in this process.

Tokens are sampled with one seed per response: a response then depends on its seed only, not on the
other responses of its batch or on where a killed command resumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from transformers import (
    LogitsProcessor,
    LogitsProcessorList,
    ProcessorMixin,
    TemperatureLogitsWarper,
    TopKLogitsWarper,
    TopPLogitsWarper,
)

from conf.schema import StudentConfig
from models.loading import DTYPES

ANSWER_TOKENS = 16
"""Most new tokens in answer mode: the answer line, and some more for a malformed one."""
THOUGHT, OPENING = "<think>", 8
"""The tag that opens a thought, and how many of a prompt's last tokens are searched for it."""


def response_token_limit(mode: str, max_new_tokens: int, thinking: bool = False) -> int:
    """Return how many tokens a response may have: few in answer mode without a thought."""
    return ANSWER_TOKENS if mode == "answer" and not thinking else max_new_tokens


@dataclass(frozen=True)
class GeneratedText:
    """A model's text, and whether generation stopped before its end."""

    text: str
    cut: bool = False


def generate(
    model: nn.Module,
    processor: ProcessorMixin,
    inputs: dict,
    limit: int,
    precision: str,
    steps: LogitsProcessorList | None = None,
) -> list[GeneratedText]:
    """Generate a response to each of a batch of left-padded prompts.

    Decoding is greedy, on the logits that `steps` return.

    Args:
        inputs: What `Collator` returns for samples without responses.
        limit: Most new tokens of a response.
        precision: bf16 or fp32.

    Returns:
        The texts; one whose prompt opens a thought begins with the opening tag.
    """
    device = next(model.parameters()).device
    inputs = {name: value.to(device) for name, value in inputs.items() if name != "labels"}
    autocast = torch.autocast(device.type, DTYPES[precision], enabled=precision == "bf16")
    # Inference mode would leave tensors in the model that cannot be trained on.
    with torch.no_grad(), autocast:
        ids = model.generate(
            **inputs,
            max_new_tokens=limit,
            do_sample=False,
            use_cache=True,
            logits_processor=steps,
        )
    prompt, new = ids[:, : inputs["input_ids"].shape[1]], ids[:, inputs["input_ids"].shape[1] :]
    tokenizer = processor.tokenizer
    opened = tokenizer.decode(prompt[0, -OPENING:]).rstrip().endswith(THOUGHT)
    texts = tokenizer.batch_decode(new, skip_special_tokens=True)
    ends = torch.tensor([tokenizer.eos_token_id, tokenizer.pad_token_id], device=new.device)
    ended = torch.isin(new, ends).any(dim=1) | (new.shape[1] < limit)
    return [
        GeneratedText(f"{THOUGHT * opened}{text}", not end)
        for text, end in zip(texts, ended.tolist(), strict=True)
    ]


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
