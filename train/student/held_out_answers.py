"""Answers that a student generates for held-out items at each evaluation of its training."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Any

from torch import nn
from transformers import ProcessorMixin

from conf.runs import rank
from conf.schema import SftCommand
from models.memory import explain_out_of_memory
from models.student.answer_parser import parse_choice
from models.student.collator import Collator
from models.student.generation import generate, response_token_limit
from train.common.journal import ANSWERS
from train.student.lazy_samples import StudentDataset

log = logging.getLogger(__name__)


class HeldOutAnswers:
    """Generates a student's answers to the first held-out samples of a mode, in one batch, and
    appends them to the run's samples.jsonl. Decoding is greedy and uses no random numbers.

    Args:
        cfg: Settings with a resolved precision.
        folder: The run's folder.
    """

    def __init__(self, cfg: SftCommand, processor: ProcessorMixin, folder: Path) -> None:
        self._cfg, self._processor = cfg, processor
        self._path = folder / ANSWERS
        self._collator = Collator(processor, cfg.student.max_length)

    def measure(
        self, model: nn.Module, mode: str, samples: StudentDataset, step: int
    ) -> dict[str, float]:
        """Return the share of answers that can be parsed and the share that is right, over the
        items that ask for a letter; empty if none does. The main rank writes the answers.

        Raises:
            UserError: out of memory.
        """
        train, student = self._cfg.train, self._cfg.student
        held_out = [samples[k] for k in range(min(train.generated_items, len(samples)))]
        inputs = self._collator([replace(sample, response=None) for sample in held_out])
        limit = response_token_limit(mode, student.max_new_tokens)
        when = f"while generating {len(held_out)} answers after step {step}"
        lower = "lower train.generated_items, or set it to 0, in another run (run=NAME)"
        with explain_out_of_memory(when, lower):
            texts = generate(model, self._processor, inputs, limit, train.precision)
        rows = []
        for sample, generated in zip(held_out, texts, strict=True):
            parsed = parse_choice(generated.text, cut=generated.cut)
            rows.append(
                {
                    "step": step,
                    "mode": mode,
                    "sample": sample.sample_id,
                    "text": generated.text,
                    "letter": parsed.letter,
                    "reason": None if parsed.letter else parsed.reason and str(parsed.reason),
                    # None for a response without an answer line.
                    "answer": parse_choice(sample.response).letter,
                }
            )
        if rank() == 0:
            self._write(rows)
        letters = [row for row in rows if row["answer"]]
        if not letters:
            return {}
        return {
            "generated_parse_rate": sum(r["letter"] is not None for r in letters) / len(letters),
            "generated_accuracy": sum(r["letter"] == r["answer"] for r in letters) / len(letters),
        }

    def _write(self, rows: list[dict[str, Any]]) -> None:
        with open(self._path, "a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        # The log prints another item at each evaluation.
        row = rows[rows[0]["step"] % len(rows)]
        answer = f"; the answer is {row['answer']}" if row["answer"] else ""
        text = indent(row["text"] or "(empty)", "    ")
        log.info("step %d, %s%s:\n%s", row["step"], row["sample"], answer, text)
