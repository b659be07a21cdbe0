"""A generator whose model is loaded in this process."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import xgrammar
from torch import nn
from transformers import ProcessorMixin
from xgrammar.contrib.hf import LogitsProcessor

from dynapix.conf.schema import SelectCommand, StudentConfig, TwoStageCommand
from dynapix.data.parallel import batched
from dynapix.evaluation.generators.response_log import (
    SampleOf,
    SaveResponses,
    Subject,
    response_seed,
)
from dynapix.evaluation.generators.response_schema import build_record_schema
from dynapix.models import loading
from dynapix.models.compat import keep_freed_memory
from dynapix.models.distributed import map_over_ranks
from dynapix.models.fingerprints import model_id, pin_revisions, processor_digest, weights_digest
from dynapix.models.memory import explain_out_of_memory
from dynapix.models.resolved_settings import check_base
from dynapix.models.student.collator import Collator
from dynapix.models.student.generation import end_tokens, generate, sampling_processors
from dynapix.models.student.responses import THOUGHT_TAG, GeneratedText, response_token_limit
from dynapix.models.trained_runs import product_folder, run_title


class LocalModel:
    """A generator: the student of the run or export in `folder`, or a base if `folder` is None.

    The model is loaded for the first response. A run whose log is complete does not load it.
    """

    def __init__(
        self,
        cfg: SelectCommand | TwoStageCommand,
        folder: Path | None,
        student: StudentConfig,
        precision: str,
    ) -> None:
        if folder is None:
            student, self._weights = pin_revisions(student), None
        else:
            check_base(folder, student)
            self._weights = product_folder(folder, "student")
        self._student, self._precision = student, precision
        self._batch, self._seed = cfg.batch, cfg.seed
        self.name = run_title(folder) if folder else f"{student.name} base"
        base = model_id(student.model, student.revision)
        self.identity: dict[str, Any] = {
            "weights": weights_digest(base, self._weights),
            "processor": processor_digest(self._weights or base),
            "revision": student.revision,
            "quantization": student.quantization,
            "precision": precision,
        }
        if student.architecture is not None and folder is None:
            self.identity["architecture"] = asdict(student.architecture)

    @cached_property
    def loaded(self) -> tuple[nn.Module, ProcessorMixin]:
        """The model and its processor, which the first access loads."""
        keep_freed_memory()
        if self._weights is not None:
            return loading.load_trained(self._student, self._precision, self._weights)
        model, processor = loading.load_base(self._student, self._precision, list)
        return loading.for_inference(model), processor

    def respond(
        self, mode: str, sample_of: SampleOf, subjects: list[Subject], save: SaveResponses
    ) -> None:
        """Generate the responses in batches, which the ranks of a launcher share.

        In constrained mode, a grammar restricts the tokens to those of a valid record.
        """
        (model, processor), student = self.loaded, self._student
        collator = Collator(processor, student.max_length, student.thinking)
        limit = response_token_limit(mode, student.max_new_tokens, student.thinking)
        grammar = compile_record_grammar(model, processor) if mode == "constrained" else None

        def respond_to_batch(batch: list[Subject]) -> list[tuple[Subject, GeneratedText]]:
            seeds = [response_seed(self._seed, subject, mode) for subject in batch]
            logits_processors = sampling_processors(student, seeds)
            if grammar is not None:
                # The grammar comes first, so that tokens are sampled from those that it allows.
                logits_processors.insert(0, LogitsProcessor(grammar))
            inputs = collator([sample_of(subject) for subject in batch])
            with explain_out_of_memory(
                f"with {len(batch)} prompts in a batch",
                "run the same command with a lower batch, which goes on after the finished answers",
            ):
                texts = generate(
                    model, processor, inputs, limit, self._precision, logits_processors
                )
            if grammar is not None:
                # `generate` adds the tag of the prompt, but the grammar has allowed no thought.
                texts = [replace(t, text=t.text.removeprefix(THOUGHT_TAG)) for t in texts]
            return list(zip(batch, texts, strict=True))

        for responses in map_over_ranks(respond_to_batch, [*batched(subjects, self._batch)]):
            save(responses)


def compile_record_grammar(model: nn.Module, processor: ProcessorMixin) -> xgrammar.CompiledGrammar:
    """Compile the record's JSON schema to a grammar over a model's tokens.

    Each batch needs its own `LogitsProcessor`, which holds the state of its responses.
    """
    tokenizer = processor.tokenizer
    tokens = xgrammar.TokenizerInfo.from_huggingface(
        tokenizer,
        vocab_size=model.config.get_text_config().vocab_size,
        # These tokens end a response, so the grammar must not allow them inside a string.
        stop_token_ids=end_tokens(processor),
    )
    # With arbitrary white space, a model could write spaces until the token limit.
    return xgrammar.GrammarCompiler(tokens).compile_json_schema(
        json.dumps(build_record_schema()), any_whitespace=False
    )
