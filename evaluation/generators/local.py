"""A model that answers on this machine, a batch of what it is asked at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torch import nn
from transformers import ProcessorMixin
from xgrammar.contrib.hf import LogitsProcessor

from conf.schema import StudentConfig
from evaluation.generators.constrained_decoding import record_grammar
from evaluation.generators.response_log import SaveResponses, Subject, response_seed
from models.memory import explain_out_of_memory
from models.student.collator import Collator
from models.student.generation import THOUGHT, generate, response_token_limit
from models.student.prompts import Sample
from models.student.token_sampling import sampling_processors


def say(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    precision: str,
    batch: int,
    seed: int,
    mode: str,
    sample_of: Callable[[Subject], Sample],
    things: list[Subject],
    keep: SaveResponses,
) -> None:
    """Have a model answer in `mode`, as `sample_of` shows and asks each; in constrained mode it can
    write nothing but a record.

    Raises:
        UserError: memory runs out.
    """
    collator = Collator(processor, cfg.max_length, cfg.thinking)
    limit = response_token_limit(mode, cfg.max_new_tokens, cfg.thinking)
    grammar = record_grammar(model, processor) if mode == "constrained" else None
    for start in range(0, len(things), batch):
        group = things[start : start + batch]
        steps = sampling_processors(cfg, [response_seed(seed, thing, mode) for thing in group])
        if grammar is not None:
            # Before tokens are drawn from what is left.
            steps.insert(0, LogitsProcessor(grammar))
        inputs = collator([sample_of(thing) for thing in group])
        when = f"where {len(group)} items are answered at once"
        with explain_out_of_memory(when, "lower batch, in a run of its own (run=NAME)"):
            written = generate(model, processor, inputs, limit, precision, steps)
        if grammar is not None:
            # What is held to a record from its first token on has no thought.
            written = [replace(w, text=w.text.removeprefix(THOUGHT)) for w in written]
        keep(list(zip(group, written, strict=True)))
