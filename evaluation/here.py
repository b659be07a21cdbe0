"""A model that answers on this machine, a batch of what it is asked at a time."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn
from transformers import ProcessorMixin

from conf.schema import StudentConfig
from evaluation.answers import Keep, Thing, seed_of
from train.collate import Collator
from train.conversation import Sample
from train.generate import generate, new_tokens
from train.loop import within_memory
from train.sampling import sampler


def say(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    precision: str,
    batch: int,
    seed: int,
    mode: str,
    sample_of: Callable[[Thing], Sample],
    things: list[Thing],
    keep: Keep,
) -> None:
    """Have a model answer in `mode`, as `sample_of` shows and asks each.

    Raises:
        UserError: memory runs out.
    """
    collator = Collator(processor, cfg.max_length, cfg.thinking)
    limit = new_tokens(mode, cfg)
    for start in range(0, len(things), batch):
        group = things[start : start + batch]
        steps = sampler(cfg, [seed_of(seed, thing, mode) for thing in group])
        inputs = collator([sample_of(thing) for thing in group])
        when = f"where {len(group)} items are answered at once"
        with within_memory(when, "lower batch, in a run of its own (run=NAME)"):
            written = generate(model, processor, inputs, limit, precision, steps)
        keep(list(zip(group, written, strict=True)))
