"""Generate a student's answers to validation samples at each evaluation of its training."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Any

from torch import nn
from transformers import ProcessorMixin

from dynapix.conf.runs import rank
from dynapix.conf.schema import StudentConfig, StudentTrainConfig
from dynapix.data.parallel import batched
from dynapix.models.distributed import is_sharded, map_over_ranks
from dynapix.models.memory import explain_out_of_memory
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.student.collator import Collator
from dynapix.models.student.generation import generate
from dynapix.models.student.prompts import Sample
from dynapix.models.student.responses import GeneratedText, response_token_limit
from dynapix.train.common.journal import ANSWERS
from dynapix.train.student.samples import StudentDataset

log = logging.getLogger(__name__)


BATCH = 4
"""Number of answers that are generated at once. The ranks share the batches."""


class HeldOutAnswers:
    """Generates a student's answers to the first validation samples of a mode, and appends them to
    the run's samples.jsonl. Decoding is greedy and uses no random numbers.

    Args:
        train: Settings whose precision is bf16 or fp32, not auto.
        folder: The run's folder.
    """

    def __init__(
        self,
        train: StudentTrainConfig,
        student: StudentConfig,
        processor: ProcessorMixin,
        folder: Path,
    ) -> None:
        self._train, self._student, self._processor = train, student, processor
        self._path = folder / ANSWERS
        self._collator = Collator(processor, student.max_length)

    def measure(
        self, model: nn.Module, mode: str, samples: StudentDataset, step: int
    ) -> dict[str, float]:
        """Generate answers, which the main rank writes, and return the shares of parsable and of
        correct answers.

        Raises:
            UserError: memory runs out.
        """
        train, student = self._train, self._student
        first = [samples[k] for k in range(min(train.generated_items, len(samples)))]
        limit = response_token_limit(mode, student.max_new_tokens)
        when = f"while generating {min(BATCH, len(first))} answers after step {step}"
        advice = "set train.generated_items=0 in another run (run=NAME)"

        def answer(batch: list[Sample]) -> list[GeneratedText]:
            inputs = self._collator([replace(sample, response=None) for sample in batch])
            with explain_out_of_memory(when, advice):
                return generate(model, self._processor, inputs, limit, train.precision)

        # Under FSDP, all ranks take part in each forward pass.
        map_batches = map if is_sharded() else map_over_ranks
        batches = [*batched(first, BATCH)]
        texts = [text for answers in map_batches(answer, batches) for text in answers]
        rows = []
        for sample, generated in zip(first, texts, strict=True):
            parsed = parse_choice(generated.text, truncated=generated.truncated)
            rows.append(
                {
                    "step": step,
                    "mode": mode,
                    "sample": sample.sample_id,
                    "text": generated.text,
                    "letter": parsed.letter,
                    "reason": None if parsed.letter else parsed.reason and str(parsed.reason),
                    "answer": parse_choice(sample.response).letter,
                }
            )
        if rank() == 0:
            self._write(rows)
        return {
            "generated_parse_rate": sum(r["letter"] is not None for r in rows) / len(rows),
            "generated_accuracy": sum(r["letter"] == r["answer"] for r in rows) / len(rows),
        }

    def _write(self, rows: list[dict[str, Any]]) -> None:
        with open(self._path, "a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        # One of the answers, which depends on the step, is logged.
        row = rows[rows[0]["step"] % len(rows)]
        text = indent(row["text"] or "(empty)", "    ")
        what = row["step"], row["sample"], row["answer"]
        log.info("step %d, %s; the answer is %s:\n%s", *what, text)
