"""Shows that a broken pipeline is noticed by its result: trains a student for a short time, as the
end-to-end test of `make test` does, once as it is and once with each of several mistakes.

    python -m benchmarks.experiments.sabotage                  # all, a minute each
    python -m benchmarks.experiments.sabotage intact           # only the unchanged pipeline

Each row has the accuracy on held-out items, and how many standard errors it is above chance. The
test demands five.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from conf.files import read_json_lines
from data.records import LETTERS
from models.student import collator, prompts
from models.student.collator import IGNORED, Encoded
from models.student.prompts import Clip, Sample

TRAINING = (
    "+exp=cot", "teacher.predicates=relational", "benchmark=short", "train.epochs=3",
    "train.evaluations=1", "train.generated_items=0",
)  # fmt: skip
EVALUATION = ("benchmark=short", "modes=[reasoning]", "batch=64")
CHANCE = 1 / len(LETTERS)
INTACT = "intact"


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
    """Train each token of the response as if it were the next one."""

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


def permute_candidates(conversation: Callable[..., Sample]) -> Callable[..., Sample]:
    """Show the candidates' images in another order than that of their letters."""

    def permuted(*args: Any, **settings: Any) -> Sample:
        sample = conversation(*args, **settings)
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


SABOTAGES = {
    INTACT: Sabotage(),
    "labels shifted by one token": Sabotage(replaced=((collator, "encode", shift_labels),)),
    "prompt masked one token too far": Sabotage(
        replaced=((collator, "encode", mask_one_token_more),)
    ),
    "candidates' images permuted": Sabotage(
        replaced=((prompts, "conversation", permute_candidates),)
    ),
    "frames in reverse": Sabotage(replaced=((prompts, "load_clip", reverse_frames),)),
    "timestamps all zero": Sabotage(replaced=((prompts, "load_clip", stop_clock),)),
    "adapters on the vision tower": Sabotage(
        ("student.lora.targets=.*visual.*(qkv|proj|linear_fc1|linear_fc2)",)
    ),
    "base not loaded": Sabotage(("student=tiny_scratch", "student.lora.rank=16")),
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
        right, total = train_and_measure(SABOTAGES[name], name, args.store, args.checkpoints)
        errors = (right - CHANCE * total) / math.sqrt(total * CHANCE * (1 - CHANCE))
        print(f"| {name} | {100 * right / total:.1f} | {errors:+.1f} |", flush=True)


def train_and_measure(
    sabotage: Sabotage, name: str, store: str, checkpoints: Path
) -> tuple[int, int]:
    """Train a student with a mistake, and measure it on held-out items with the same mistake.

    Returns:
        The number of right answers and the number of items.
    """
    run = f"sabotage-{name.replace(' ', '_')}"
    shared = [f"store={store}", f"checkpoints={checkpoints}", f"run={run}"]
    student = checkpoints / "sft" / run
    with sabotage.active():
        run_command("train.sft", [*TRAINING, *sabotage.overrides, *shared])
        run_command("evaluation.select", [*EVALUATION, f"model={student}", *shared])
    lines = list(read_json_lines(checkpoints / "select" / run / "answers.jsonl"))
    answers = [line for line in lines if "item_id" in line]
    return sum(line["right"] for line in answers), len(answers)


def run_command(name: str, overrides: Sequence[str]) -> None:
    """Run a command of the project in this process."""
    with patch.object(sys, "argv", [name, *overrides]):
        import_module(name).main()


if __name__ == "__main__":
    main()
