"""Text generation with a model that is loaded in this process."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn
from transformers import LogitsProcessorList, ProcessorMixin

from conf.schema import StudentConfig
from models.loading import DTYPES

ANSWER_TOKENS = 16
"""New tokens at most in answer mode: the one line, and room to miss it."""
THOUGHT, OPENING = "<think>", 8
"""What opens a thought, and how many tokens at a prompt's end are looked at for it."""


def response_token_limit(mode: str, cfg: StudentConfig) -> int:
    """How many tokens a student may write in a mode."""
    return ANSWER_TOKENS if mode == "answer" and not cfg.thinking else cfg.max_new_tokens


@dataclass(frozen=True)
class GeneratedText:
    """What a model wrote; whether it was stopped before its end."""

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
    """What a model writes after left-padded prompts, `limit` tokens at most: greedily, after the
    logits have passed the `steps`. A thought that the prompt opens is opened in the text."""
    device = next(model.parameters()).device
    inputs = {name: value.to(device) for name, value in inputs.items() if name != "labels"}
    autocast = torch.autocast(device.type, DTYPES[precision], enabled=precision == "bf16")
    # No inference mode: what it leaves in a model could not be trained on.
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
