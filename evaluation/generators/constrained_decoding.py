"""Holds a model that is loaded here to the structured record, as servers do by a grammar."""

from __future__ import annotations

import json

import xgrammar
from torch import nn
from transformers import ProcessorMixin

from evaluation.generators.response_schema import schema


def record_grammar(model: nn.Module, processor: ProcessorMixin) -> xgrammar.CompiledGrammar:
    """The record's JSON schema over a model's tokens. A batch takes an
    `xgrammar.contrib.hf.LogitsProcessor` of its own over it."""
    tokenizer = processor.tokenizer
    tokens = xgrammar.TokenizerInfo.from_huggingface(
        tokenizer,
        vocab_size=model.config.get_text_config().vocab_size,
        # Either ends an answer, and would end it in the midst of a text.
        stop_token_ids=[tokenizer.eos_token_id, tokenizer.pad_token_id],
    )
    # Free space could go on for ever.
    return xgrammar.GrammarCompiler(tokens).compile_json_schema(
        json.dumps(schema()), any_whitespace=False
    )
