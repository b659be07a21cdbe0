"""Answers that a student generates for held-out items at each evaluation of a training run."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Any

from torch import nn
from transformers import ProcessorMixin

from conf.schema import StudentConfig
from models.memory import explain_out_of_memory
from models.student.answer_parser import parse_choice
from models.student.collator import Collator
from models.student.generation import GeneratedText, generate, response_token_limit
from train.common.journal import WRITTEN
from train.student.lazy_samples import Samples

log = logging.getLogger(__name__)


class HeldOutAnswers:
    """Asks a student for its answers to the first held-out samples of a mode, all at once, and
    keeps them in the run's samples.jsonl. Decoding is greedy: the run's chance is not touched."""

    def __init__(
        self,
        processor: ProcessorMixin,
        cfg: StudentConfig,
        precision: str,
        count: int,
        folder: Path,
    ) -> None:
        self._processor, self._cfg, self._precision = processor, cfg, precision
        self._count = count
        self._path = folder / WRITTEN
        self._collator = Collator(processor, cfg.max_length)

    def measure(
        self, model: nn.Module, mode: str, samples: Samples, step: int, keep: bool = True
    ) -> dict[str, float]:
        """The share of answers whose letter can be read, and of those that are right, over the
        items that ask for a letter; nothing where none does. `keep` writes the answers down.

        Raises:
            UserError: memory runs out.
        """
        asked = [samples[k] for k in range(min(self._count, len(samples)))]
        inputs = self._collator([replace(sample, response=None) for sample in asked])
        limit = response_token_limit(mode, self._cfg)
        when = f"where the student answers {len(asked)} held-out items after step {step}"
        lower = "lower train.generated_items, or set it to 0, in a run of its own (run=NAME)"
        with explain_out_of_memory(when, lower):
            texts = generate(model, self._processor, inputs, limit, self._precision)
        rows = [
            _row(step, mode, sample.sample_id, written, sample.response)
            for sample, written in zip(asked, texts, strict=True)
        ]
        if keep:
            self._keep(rows)
        letters = [row for row in rows if row["answer"]]
        if not letters:
            return {}
        return {
            "generated_parse_rate": sum(r["letter"] is not None for r in letters) / len(letters),
            "generated_accuracy": sum(r["letter"] == r["answer"] for r in letters) / len(letters),
        }

    def _keep(self, rows: list[dict[str, Any]]) -> None:
        with open(self._path, "a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        # Another item at each evaluation, so that the log shows several of them.
        shown = rows[rows[0]["step"] % len(rows)]
        told = f"; the answer is {shown['answer']}" if shown["answer"] else ""
        text = indent(shown["text"] or "(nothing)", "    ")
        log.info("step %d, %s%s:\n%s", shown["step"], shown["sample"], told, text)


def _row(
    step: int, mode: str, sample: str, written: GeneratedText, response: str
) -> dict[str, Any]:
    """One line of samples.jsonl; `answer` is the right letter, as it stands in the response that
    is held out, and null where none is asked for."""
    choice = parse_choice(written.text, cut=written.cut)
    return {
        "step": step,
        "mode": mode,
        "sample": sample,
        "text": written.text,
        "letter": choice.letter,
        "reason": None if choice.letter else choice.reason and str(choice.reason),
        "answer": parse_choice(response).letter,
    }
