"""Constrained decoding of the structured record with a local model."""

from __future__ import annotations

import json

import xgrammar
from torch import nn
from transformers import ProcessorMixin

from evaluation.generators.response_schema import schema


def compile_record_grammar(model: nn.Module, processor: ProcessorMixin) -> xgrammar.CompiledGrammar:
    """Compile the record's JSON schema over a model's tokens.

    Each batch needs its own `xgrammar.contrib.hf.LogitsProcessor`.
    """
    tokenizer = processor.tokenizer
    tokens = xgrammar.TokenizerInfo.from_huggingface(
        tokenizer,
        vocab_size=model.config.get_text_config().vocab_size,
        # Both end a response, so the grammar must not allow them inside a string.
        stop_token_ids=[tokenizer.eos_token_id, tokenizer.pad_token_id],
    )
    # Free whitespace would let a model write spaces until the token limit.
    return xgrammar.GrammarCompiler(tokens).compile_json_schema(
        json.dumps(schema()), any_whitespace=False
    )
