"""Measures variants of a training in turns, each in a process of its own, and prints a table."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from tqdm import tqdm
from transformers import (
    PrinterCallback,
    ProgressCallback,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
    Trainer,
    TrainerCallback,
)

from conf.errors import UserError
from conf.runs import Run
from conf.schema import TrainConfig
from models.tiny_qwen3_vl import SPECIAL_TOKENS, build_processor
from train.common.arguments import common_arguments

SEED = 0
CONFIGS = Path(__file__).parents[2] / "tests/models/configs"
"""The configurations of the released models."""


@dataclass(frozen=True)
class Measurements:
    """Measurements of a training."""

    rate: float
    """Samples or queries per second after the first step, including the loading of their inputs."""
    peak: float
    """Peak memory (GiB) of tensors on the GPU, or of the process on a CPU."""
    losses: list[float]
    """Loss of each step."""


class Clock(TrainerCallback):
    """Records the end time and the loss of each step, and the peak memory."""

    def __init__(self) -> None:
        self.ends: list[float] = []
        self.losses: list[float] = []
        self.peak = 0.0

    def on_train_begin(self, *_: Any, **__: Any) -> None:
        reset_peak_memory()

    def on_step_end(self, *_: Any, **__: Any) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.ends.append(time.perf_counter())

    def on_log(self, args, state, control, logs=None, **_: Any) -> None:
        if "loss" in (logs or {}):
            self.losses.append(logs["loss"])

    def on_train_end(self, *_: Any, **__: Any) -> None:
        self.peak = peak_memory() / 2**30


def train(trainer: Trainer, batch: int) -> Measurements:
    """Train to the end; `batch` is the number of samples or queries of a step."""
    clock = Clock()
    trainer.add_callback(clock)
    for callback in (ProgressCallback, PrinterCallback):
        trainer.remove_callback(callback)
    trainer.train()
    seconds = [end - start for start, end in pairwise(clock.ends)]
    return Measurements(batch * len(seconds) / sum(seconds), clock.peak, clock.losses)


def timing_arguments(train: TrainConfig, folder: Path) -> dict[str, Any]:
    """The arguments of a project's trainer, without evaluations and checkpoints."""
    never = {"eval_strategy": "no", "eval_on_start": False, "save_strategy": "no"}
    common = common_arguments(train, Run("benchmark", folder), SEED, None)
    return {**common, **never, "disable_tqdm": True}


def run_in_process(
    function: Callable[..., Any], *arguments: Any, environment: Mapping[str, str] = {}
) -> Any:
    """Call a function in a new process with further environment variables; returns its result."""
    with (
        patch.dict(os.environ, {"HF_HUB_OFFLINE": "1", **environment}),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        return pool.submit(function, *arguments).result()


def add_arguments(parser: argparse.ArgumentParser, steps: int, variants: Sequence[str]) -> None:
    """Add the options of every comparison."""
    parser.add_argument("preset", nargs="?", default="tiny", help="tiny or a released preset")
    parser.add_argument("--quantization", choices=["nf4", "none"], default="nf4")
    parser.add_argument("--precision", default="auto", help="bf16, fp32 or auto")
    parser.add_argument("--steps", type=int, default=steps, help="timed steps after a first one")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--store", default="store", help="folder of the built benchmarks")
    parser.add_argument("--only", nargs="*", choices=list(variants), help="variants to measure")


def compare(
    measure: Callable[[str], Measurements],
    names: Sequence[str],
    reference: str,
    unit: str,
    rounds: int,
) -> dict[str, list[Measurements]]:
    """Measure variants in turns, and print medians and the medians of their ratios.

    Args:
        measure: Measures the variant of a name. One that has too little memory or cannot be
            trained with its settings is left out.
        reference: Variant that all others are compared with.
        unit: What a rate counts, such as samples.

    Returns:
        The measurements of each variant that was measured, by round.
    """
    turns = [name for _ in range(rounds) for name in names]
    results: dict[str, list[Measurements | str]] = {name: [] for name in names}
    for name in tqdm(turns, unit="training"):
        try:
            results[name].append(measure(name))
        except torch.OutOfMemoryError:
            results[name].append("out of memory")
        except UserError as error:
            results[name].append(str(error))
    print(f"{'':<44}{unit + '/s':>11}{'ratio':>8}{'peak GiB':>10}{'ratio':>8}{'loss':>10}")
    measured = {}
    for name, found in results.items():
        if failures := [result for result in found if isinstance(result, str)]:
            print(f"{name:<44}{failures[0]}", flush=True)
            continue
        measured[name] = found
        line = f"{name:<44}"
        for field, width in (("rate", 11), ("peak", 10)):
            line += f"{statistics.median(getattr(r, field) for r in found):>{width}.2f}"
            line += f"{median_ratio(found, measured.get(reference, []), field):>8.2f}"
        print(f"{line}{found[0].losses[-1]:>10.4f}", flush=True)
    return measured


def median_ratio(
    found: Sequence[Measurements], reference: Sequence[Measurements], field: str
) -> float:
    """Median over the rounds of a measurement's ratio to the reference; NaN without a reference."""
    pairs = zip(found, reference, strict=False)
    ratios = [getattr(a, field) / getattr(b, field) for a, b in pairs]
    return statistics.median(ratios) if ratios else float("nan")


def write_random_base(preset: str, texts: list[str], image_size: int, folder: Path) -> None:
    """Save a base of a released model's shape with random bf16 weights, so that nothing is
    downloaded. Its tokenizer is trained on `texts`."""
    config = Qwen3VLConfig.from_dict(json.loads((CONFIGS / f"{preset}.json").read_text()))
    for key, token in (
        ("image_token_id", "<|image_pad|>"),
        ("video_token_id", "<|video_pad|>"),
        ("vision_start_token_id", "<|vision_start|>"),
        ("vision_end_token_id", "<|vision_end|>"),
    ):
        setattr(config, key, SPECIAL_TOKENS.index(token))
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        with torch.device("cuda" if torch.cuda.is_available() else "cpu"):
            Qwen3VLForConditionalGeneration(config).save_pretrained(folder)
    finally:
        torch.set_default_dtype(default)
    build_processor(texts, 1024, image_size).save_pretrained(folder)


def device_name() -> str:
    if torch.cuda.is_available():
        return torch.cuda.get_device_name()
    return f"a CPU with {torch.get_num_threads()} threads"


def reset_peak_memory() -> None:
    """Start to count the memory for `peak_memory`."""
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    elif sys.platform.startswith("linux"):
        libc = ctypes.CDLL(None)
        if hasattr(libc, "malloc_trim"):
            # Memory that earlier steps freed would hide what this one allocates.
            libc.malloc_trim(0)
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the maximum memory (bytes) since `reset_peak_memory`, or since the process started
    where the system cannot reset its count."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated()
    if sys.platform.startswith("linux"):
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
