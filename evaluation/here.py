"""A model that answers on this machine, a batch of items at a time."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn
from transformers import ProcessorMixin

from conf.schema import StudentConfig
from data.records import SelectionItem
from evaluation.answers import Keep, seed_of
from train.collate import Collator
from train.conversation import Sample
from train.generate import generate, new_tokens
from train.sampling import sampler


def say(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    precision: str,
    batch: int,
    seed: int,
    mode: str,
    sample_of: Callable[[SelectionItem], Sample],
    items: list[SelectionItem],
    keep: Keep,
) -> None:
    """Have a model answer items in `mode`, as `sample_of` shows and asks them."""
    collator = Collator(processor, cfg.max_length, cfg.thinking)
    limit = new_tokens(mode, cfg)
    for start in range(0, len(items), batch):
        group = items[start : start + batch]
        steps = sampler(cfg, [seed_of(seed, item, mode) for item in group])
        inputs = collator([sample_of(item) for item in group])
        written = generate(model, processor, inputs, limit, precision, steps)
        keep(list(zip(group, written, strict=True)))
