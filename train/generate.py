"""What a student writes when it is asked: by the evaluation command, and at each evaluation of a
training run, where it answers a few held-out items and the answers are read as they will be."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import indent
from typing import Any

import torch
from torch import nn
from transformers import LogitsProcessorList, ProcessorMixin

from conf.schema import StudentConfig
from train.backbone import DTYPES
from train.choice import parse
from train.collate import Collator
from train.journal import WRITTEN
from train.loop import within_memory
from train.planned import Samples

log = logging.getLogger(__name__)

ANSWER_TOKENS = 16
"""New tokens at most in answer mode: the one line, and room to miss it."""
THOUGHT, OPENING = "<think>", 8
"""What opens a thought, and how many tokens at a prompt's end are looked at for it."""


def new_tokens(mode: str, cfg: StudentConfig) -> int:
    """How many tokens a student may write in a mode."""
    return ANSWER_TOKENS if mode == "answer" and not cfg.thinking else cfg.max_new_tokens


@dataclass(frozen=True)
class Written:
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
) -> list[Written]:
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
        Written(f"{THOUGHT * opened}{text}", not end)
        for text, end in zip(texts, ended.tolist(), strict=True)
    ]


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
        limit = new_tokens(mode, self._cfg)
        when = f"where the student answers {len(asked)} held-out items after step {step}"
        lower = "lower train.generated_items, or set it to 0, in a run of its own (run=NAME)"
        with within_memory(when, lower):
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


def _row(step: int, mode: str, sample: str, written: Written, response: str) -> dict[str, Any]:
    """One line of samples.jsonl; `answer` is the right letter, as it stands in the response that
    is held out, and null where none is asked for."""
    choice = parse(written.text, cut=written.cut)
    return {
        "step": step,
        "mode": mode,
        "sample": sample,
        "text": written.text,
        "letter": choice.letter,
        "reason": None if choice.letter else choice.reason and str(choice.reason),
        "answer": parse(response).letter,
    }
