"""Measures the speed and memory of variants of a training in several rounds, and prints a table."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd
import psutil
import torch
from tqdm import tqdm
from transformers import (
    AutoModelForImageTextToText,
    PrinterCallback,
    ProgressCallback,
    Qwen3VLConfig,
    Trainer,
    TrainerCallback,
)

from benchmarks.arguments import positive_int
from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.runs import Run
from dynapix.conf.schema import TrainConfig
from dynapix.models.resolved_settings import resolve_precision
from dynapix.models.tiny_qwen3_vl import SPECIAL_TOKENS, build_processor
from dynapix.train.common.training_loop import common_arguments

OURS = "ours"
"""Name of the variant that uses this project's trainer with the preset's settings."""
SEED = 0
TRAINING_ONLY = {
    "eval_strategy": "no", "eval_on_start": False, "save_strategy": "no",
    "load_best_model_at_end": False, "disable_tqdm": True,
}  # fmt: skip
"""Arguments of a trainer that disable evaluations, checkpoints and the progress bar."""
MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 30),
    "MALLOC_TRIM_THRESHOLD_": str((1 << 31) - 1),
    "MALLOC_TOP_PAD_": str(64 << 20),
}
"""Environment variables with the effect of `models.compat.keep_freed_memory`."""
AVX2 = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
}
"""Environment variables that hold the libraries to a processor without bf16 and AVX-512."""
CONFIGS = Path(__file__).parents[2] / "tests/models/configs"
"""The configurations of the released models."""


@dataclass(frozen=True)
class Measurements:
    """Measurements of a training."""

    rate: float
    """Samples or queries per second after the first step; the time to load inputs is included."""
    cpu: float
    """CPU seconds of the process and its workers per sample or query, after the first step."""
    peak: float
    """Peak memory (GiB) of tensors on the GPU, or of the process on a CPU."""
    losses: list[float]
    """Loss of each step."""


class Clock(TrainerCallback):
    """Records the end time of each step, and the CPU seconds up to then."""

    def __init__(self) -> None:
        self.ends: list[float] = []
        self.cpu: list[float] = []

    def on_step_end(self, *_: Any, **__: Any) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        self.ends.append(time.perf_counter())
        process = psutil.Process()
        times = [p.cpu_times() for p in (process, *process.children(recursive=True))]
        self.cpu.append(sum(t.user + t.system for t in times))


def train(trainer: Trainer, batch: int) -> Measurements:
    """Train without evaluations and checkpoints; `batch` is the number of samples or queries per
    step."""
    clock = Clock()
    trainer.add_callback(clock)
    for callback in (ProgressCallback, PrinterCallback):
        trainer.remove_callback(callback)
    for key, value in TRAINING_ONLY.items():
        setattr(trainer.args, key, value)
    reset_peak_memory()
    trainer.train()
    peak = peak_memory() / 2**30
    seconds, samples = clock.ends[-1] - clock.ends[0], batch * (len(clock.ends) - 1)
    cpu = clock.cpu[-1] - clock.cpu[0]
    losses = [entry["loss"] for entry in trainer.state.log_history if "loss" in entry]
    return Measurements(samples / seconds, cpu / samples, peak, losses)


def timing_arguments(train: TrainConfig, folder: Path) -> dict[str, Any]:
    """Return this project's training arguments, without evaluations and checkpoints."""
    return {**common_arguments(train, Run("benchmark", folder), SEED, None), **TRAINING_ONLY}


def run_in_process(
    function: Callable[..., Any], *arguments: Any, environment: Mapping[str, str] = {}
) -> Any:
    """Call a function in a new process with additional environment variables; return its result."""
    with (
        patch.dict(os.environ, {"HF_HUB_OFFLINE": "1", **environment}),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        return pool.submit(function, *arguments).result()


def add_arguments(parser: argparse.ArgumentParser, steps: int, variants: Sequence[str]) -> None:
    """Add the options of every comparison."""
    parser.add_argument("preset", nargs="?", default="tiny", help="tiny or a released preset")
    parser.add_argument(
        "--quantization", choices=["nf4", "none"], help="default: none for tiny, nf4 for others"
    )
    parser.add_argument("--precision", default="auto", help="bf16, fp32 or auto")
    parser.add_argument(
        "--avx2", action="store_true", help="fp32, without the instructions of newer processors"
    )
    parser.add_argument(
        "--steps", type=positive_int, default=steps, help="steps to time, after the first"
    )
    parser.add_argument("--rounds", type=positive_int, default=3)
    parser.add_argument("--store", default="store", help="folder of the built benchmarks")
    parser.add_argument("--only", nargs="*", choices=list(variants), help="variants to measure")


def parse_arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the options of a comparison, and set its precision and quantisation."""
    args = parser.parse_args()
    if args.avx2:
        os.environ.update(AVX2)
        args.precision = "fp32"
    args.precision = resolve_precision(args.precision)
    args.quantization = args.quantization or ("none" if args.preset == "tiny" else "nf4")
    return args


def compare(
    measure: Callable[[str], Measurements],
    names: Sequence[str],
    reference: str,
    unit: str,
    args: argparse.Namespace,
) -> None:
    """Measure each variant once per round, and print the medians over the rounds.

    The ratios to a reference variant of the same round are printed too: their median and, for
    rates, the lowest and the highest. A variant that runs out of memory or cannot be trained with
    its settings is left out.

    Args:
        measure: Measures a variant by its name.
        reference: Name of the reference variant.
        unit: What a rate counts, such as samples.
        args: Options of `parse_arguments`.
    """
    rows, failures = [], {}
    for number, name in tqdm(list(product(range(args.rounds), names)), unit="training"):
        try:
            found = measure(name)
        except torch.OutOfMemoryError:
            failures[name] = "out of memory"
        except SettingsError:
            raise
        except UserError as error:
            failures[name] = str(error)
        else:
            measures = found.rate, found.cpu, found.peak
            rows.append((name, number, *measures, found.losses[-1]))
    for name, failure in failures.items():
        print(f"{name}: {failure}")
    rate = f"{unit}/s"
    columns = ["variant", "round", rate, "CPU s", "peak GiB", "loss"]
    table = pd.DataFrame(rows, columns=columns)
    table = table[~table["variant"].isin(failures)].set_index(["round", "variant"])
    medians = table.groupby("variant", sort=False).median()
    if reference in medians.index:
        ratios = table / table.xs(reference, level="variant").reindex(table.index, level="round")
        of_variants = ratios.drop(columns="loss").groupby("variant")
        medians = medians.join(of_variants.median(), rsuffix=", ratio")
        spread = of_variants[rate].agg(["min", "max"]).add_prefix(f"{rate}, ratio, ")
        medians = medians.join(spread)
    print(medians.to_string(float_format="{:.3f}".format), flush=True)


def write_random_base(preset: str, texts: list[str], image_size: int, folder: Path) -> None:
    """Save a base with the architecture of a released model and random bf16 weights, for which
    nothing is downloaded. Its tokenizer is trained on `texts`."""
    config = Qwen3VLConfig.from_dict(json.loads((CONFIGS / f"{preset}.json").read_text()))
    for key, token in (
        ("image_token_id", "<|image_pad|>"),
        ("video_token_id", "<|video_pad|>"),
        ("vision_start_token_id", "<|vision_start|>"),
        ("vision_end_token_id", "<|vision_end|>"),
    ):
        setattr(config, key, SPECIAL_TOKENS.index(token))
    with torch.device("cuda" if torch.cuda.is_available() else "cpu"):
        model = AutoModelForImageTextToText.from_config(config, dtype=torch.bfloat16)
    model.save_pretrained(folder)
    build_processor(texts, 1024, image_size, patch=16).save_pretrained(folder)


def reset_peak_memory() -> None:
    """Restart the measurement of `peak_memory`."""
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
        return
    # Memory that was freed but not returned to the system would hide later allocations.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the peak memory (bytes) since `reset_peak_memory`."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated()
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) << 10
