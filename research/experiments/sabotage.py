"""Measures whether the accuracy of a short training reveals a broken pipeline: trains a student on
`benchmark=short`, once as it is and once with each of several mistakes.

    python -m research.experiments.sabotage                  # all, a minute each
    python -m research.experiments.sabotage intact           # only the unchanged pipeline

Each row has the accuracy on held-out items, and how many standard errors it is above chance. A
mistake that a command refuses is listed as refused.
"""

from __future__ import annotations

import argparse
import math
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from transformers import PreTrainedModel, ProcessorMixin

from dynapix.conf.failures import report_failures
from dynapix.conf.files import read_json_lines
from dynapix.data.records import LETTERS
from dynapix.models import loading
from dynapix.models.student import collator, prompts
from dynapix.models.student.collator import IGNORED, Encoded
from dynapix.models.student.prompts import Clip, Sample

TRAINING = (
    "+exp=cot", "teacher.predicates=relational", "benchmark=short", "train.epochs=1",
    "train.evaluations=1", "train.validation_items=8", "train.generated_items=0",
)  # fmt: skip
EVALUATION = ("benchmark=short", "modes=[reasoning]", "batch=64")
CHANCE = 1 / len(LETTERS)
INTERRUPTED = 130
"""Exit status of a command that Ctrl-C interrupts."""
INTACT = "intact"
Loaded = tuple[PreTrainedModel, ProcessorMixin]


@dataclass(frozen=True)
class Sabotage:
    """A mistake in the pipeline.

    Attributes:
        overrides: Settings of the training.
        replaced: Functions by module and name, each with a function that takes the original and
            returns its replacement, in training and evaluation.
    """

    overrides: tuple[str, ...] = ()
    replaced: tuple[tuple[Any, str, Callable[[Callable], Callable]], ...] = ()

    @contextmanager
    def active(self) -> Iterator[None]:
        with ExitStack() as stack:
            for module, name, change in self.replaced:
                stack.enter_context(patch.object(module, name, change(getattr(module, name))))
            yield


def shift_labels(encode: Callable[..., Encoded]) -> Callable[..., Encoded]:
    """Train each position to predict the token after the next one."""

    def shifted(*args: Any, **settings: Any) -> Encoded:
        encoded = encode(*args, **settings)
        return replace(encoded, labels=[*encoded.labels[1:], IGNORED])

    return shifted


def mask_one_token_more(encode: Callable[..., Encoded]) -> Callable[..., Encoded]:
    """Leave the first token of the response out of the loss."""

    def masked(*args: Any, **settings: Any) -> Encoded:
        encoded = encode(*args, **settings)
        supervised = [k for k, label in enumerate(encoded.labels) if label != IGNORED][:1]
        labels = [IGNORED if k in supervised else x for k, x in enumerate(encoded.labels)]
        return replace(encoded, labels=labels)

    return masked


def permute_candidates(build: Callable[..., Sample]) -> Callable[..., Sample]:
    """Show the candidates' images in another order than that of their letters."""

    def permuted(*args: Any, **settings: Any) -> Sample:
        sample = build(*args, **settings)
        seed = [ord(letter) for letter in sample.sample_id]
        order = np.random.default_rng(seed).permutation(len(sample.images))
        return replace(sample, images=[sample.images[k] for k in order])

    return permuted


def reverse_frames(load_clip: Callable[..., Clip]) -> Callable[..., Clip]:
    """Show the prefix backwards."""

    def reversed_clip(*args: Any) -> Clip:
        clip = load_clip(*args)
        return replace(clip, pixels=clip.pixels[::-1].copy())

    return reversed_clip


def stop_clock(load_clip: Callable[..., Clip]) -> Callable[..., Clip]:
    """Give all frames of the prefix the time zero."""

    def timeless(*args: Any) -> Clip:
        return replace(load_clip(*args), fps=1e6)

    return timeless


def forget_weights(load_base: Callable[..., Loaded]) -> Callable[..., Loaded]:
    """Give the base the same random weights in training and evaluation."""

    def forgotten(*args: Any) -> Loaded:
        model, processor = load_base(*args)
        with torch.random.fork_rng(), torch.no_grad():
            torch.manual_seed(0)
            for weight in model.parameters():
                if weight.dim() > 1:
                    weight.normal_(std=0.02)
        return model, processor

    return forgotten


SABOTAGES = {
    INTACT: Sabotage(),
    "labels shifted by one token": Sabotage(replaced=((collator, "encode", shift_labels),)),
    "prompt masked one token too far": Sabotage(
        replaced=((collator, "encode", mask_one_token_more),)
    ),
    "candidates' images permuted": Sabotage(
        replaced=((prompts, "build_sample", permute_candidates),)
    ),
    "frames in reverse": Sabotage(replaced=((prompts, "load_clip", reverse_frames),)),
    "timestamps all zero": Sabotage(replaced=((prompts, "load_clip", stop_clock),)),
    "adapters on the vision tower": Sabotage(("student.lora.targets='.*visual.*(qkv|proj)'",)),
    "base not loaded": Sabotage(replaced=((loading, "load_base", forget_weights),)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SABOTAGES)}; all by default")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", type=Path, default=Path("checkpoints"))
    args = parser.parse_args()
    if unknown := set(args.names) - set(SABOTAGES):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; choose from {', '.join(SABOTAGES)}")
    print("| | right, % | standard errors above chance |\n|---|---|---|", flush=True)
    for name in args.names or SABOTAGES:
        result = train_and_measure(SABOTAGES[name], name, args.store, args.checkpoints)
        if result is None:
            print(f"| {name} | refused | |", flush=True)
        else:
            share, errors = 100 * result.right / result.total, result.errors_above_chance
            print(f"| {name} | {share:.1f} | {errors:+.1f} |", flush=True)


class Result(NamedTuple):
    """The number of right answers, and the number of items."""

    right: int
    total: int

    @property
    def errors_above_chance(self) -> float:
        """How many standard errors of chance the result is above chance."""
        variance = self.total * CHANCE * (1 - CHANCE)
        return (self.right - CHANCE * self.total) / math.sqrt(variance)


def train_and_measure(
    sabotage: Sabotage, name: str, store: str, checkpoints: Path
) -> Result | None:
    """Train a student with a mistake, and measure it on held-out items with the same mistake. The
    runs of an earlier measurement are deleted.

    Returns:
        None if the training refuses the mistake.
    """
    run = f"sabotage-{re.sub('[^a-z]+', '_', name)}"
    for kind in ("sft", "select"):
        shutil.rmtree(checkpoints / kind / run, ignore_errors=True)
    shared = [f"store={store}", f"checkpoints={checkpoints}", f"run={run}"]
    student = checkpoints / "sft" / run
    with sabotage.active():
        try:
            run_in_process("train.sft", [*TRAINING, *sabotage.overrides, *shared])
        except SystemExit as error:
            if sabotage == SABOTAGES[INTACT] or error.code == INTERRUPTED:
                raise
            return None
        run_in_process("evaluation.select", [*EVALUATION, f"model={student}", *shared])
    lines = list(read_json_lines(checkpoints / "select" / run / "answers.jsonl"))
    answers = [line for line in lines if "item_id" in line]
    return Result(sum(line["right"] for line in answers), len(answers))


def run_in_process(name: str, overrides: Sequence[str]) -> None:
    """Run a command of the project in this process."""
    with patch.object(sys, "argv", [name, *overrides]):
        import_module(f"dynapix.{name}").main()


if __name__ == "__main__":
    with report_failures():
        main()
