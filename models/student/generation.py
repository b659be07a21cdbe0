"""Generate text with a model that is loaded in this process.

Each response is sampled with its own seed, so that it depends neither on the other responses in its
batch nor on the response at which a killed command resumes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from peft import PeftModel
from torch import nn
from transformers import (
    GenerationConfig,
    LogitsProcessor,
    LogitsProcessorList,
    ProcessorMixin,
    TemperatureLogitsWarper,
    TopKLogitsWarper,
    TopPLogitsWarper,
)

from dynapix.conf.schema import StudentConfig
from dynapix.models.loading import DTYPES
from dynapix.models.student.chat_format import find_end_token
from dynapix.models.student.kv_cache import create_cache
from dynapix.models.student.responses import THOUGHT_TAG, GeneratedText

TAG_SEARCH_TOKENS = 8
"""Number of tokens at the end of a prompt in which the tag is searched."""


def generate(
    model: nn.Module,
    processor: ProcessorMixin,
    inputs: dict,
    limit: int,
    precision: str,
    logits_processors: LogitsProcessorList | None = None,
) -> list[GeneratedText]:
    """Generate a response to each prompt of a left-padded batch.

    Decoding is greedy: each new token has the largest logit after `logits_processors` are applied.
    With those of `sampling_processors`, this token is a random sample.

    Args:
        inputs: What `Collator` returns for samples without responses, all in one mode.
        limit: Maximum number of new tokens of a response.
        precision: bf16 or fp32.

    Returns:
        The texts. If the prompts end with `THOUGHT_TAG`, the texts begin with it.
    """
    device = next(model.parameters()).device
    inputs = {name: value.to(device) for name, value in inputs.items() if name != "labels"}
    autocast = torch.autocast(device.type, DTYPES[precision], enabled=precision == "bf16")
    # Tensors that the model stores under torch.inference_mode could not be used in later training.
    with torch.no_grad(), autocast, plain_decoding(model, processor, limit):
        ids = model.generate(
            **inputs,
            past_key_values=create_cache(model),
            logits_processor=logits_processors,
        )
    prompt, new = ids[:, : inputs["input_ids"].shape[1]], ids[:, inputs["input_ids"].shape[1] :]
    tokenizer = processor.tokenizer
    prompt_end = tokenizer.decode(prompt[0, -TAG_SEARCH_TOKENS:]).rstrip()
    start = THOUGHT_TAG if prompt_end.endswith(THOUGHT_TAG) else ""
    texts = tokenizer.batch_decode(new, skip_special_tokens=True)
    ends = torch.tensor(end_tokens(processor), device=new.device)
    is_end = torch.isin(new, ends)
    ended = is_end.any(dim=1) | (new.shape[1] < limit)
    # The tokens after the first end are padding.
    lengths = torch.where(is_end.any(dim=1), is_end.int().argmax(dim=1) + 1, new.shape[1])
    return [
        GeneratedText(start + text, not end, tuple(row[:length]))
        for text, end, row, length in zip(
            texts, ended.tolist(), new.tolist(), lengths.tolist(), strict=True
        )
    ]


def end_tokens(processor: ProcessorMixin) -> list[int]:
    """Return the ids of the tokens that end a response: the end of a turn, of a text, padding."""
    tokenizer = processor.tokenizer
    ends = [find_end_token(processor), tokenizer.eos_token_id, tokenizer.pad_token_id]
    return list(dict.fromkeys(ends))


@contextmanager
def plain_decoding(model: nn.Module, processor: ProcessorMixin, limit: int) -> Iterator[None]:
    """Replace a model's generation config, with its sampling and its penalties, by greedy decoding.

    A config that is given to `generate` would be filled up with the values of the model's own.
    """
    plain = GenerationConfig(
        max_new_tokens=limit,
        do_sample=False,
        eos_token_id=end_tokens(processor),
        pad_token_id=processor.tokenizer.pad_token_id,
    )
    # With adapters, peft copies the config of the whole model to its base.
    models = [model, model.get_base_model()] if isinstance(model, PeftModel) else [model]
    own = [part.generation_config for part in models]
    for part in models:
        part.generation_config = plain
    try:
        yield
    finally:
        for part, config in zip(models, own, strict=True):
            part.generation_config = config


def sampling_processors(cfg: StudentConfig, seeds: Sequence[int]) -> LogitsProcessorList:
    """Return logits processors that turn greedy decoding into sampling, with one seed per row. At
    temperature 0, the list is empty."""
    processors = LogitsProcessorList()
    if cfg.temperature:
        processors.append(TemperatureLogitsWarper(float(cfg.temperature)))
        if cfg.top_k:
            processors.append(TopKLogitsWarper(cfg.top_k))
        if cfg.top_p < 1:
            processors.append(TopPLogitsWarper(float(cfg.top_p)))
        processors.append(GumbelNoise(seeds))
    return processors


class GumbelNoise(LogitsProcessor):
    """Adds Gumbel noise to logits (B, V), whose argmax is then a sample from their softmax."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self._seeds = seeds
        self._generators: list[torch.Generator] | None = None

    def __call__(self, input_ids: torch.LongTensor, scores: torch.FloatTensor) -> torch.FloatTensor:
        if self._generators is None:
            # The device is known only from the first logits.
            self._generators = [
                torch.Generator(scores.device).manual_seed(seed) for seed in self._seeds
            ]
        noise = torch.empty_like(scores)
        for row, generator in zip(noise, self._generators, strict=True):
            row.exponential_(generator=generator)
        return scores - noise.clamp_min(torch.finfo(noise.dtype).tiny).log()
