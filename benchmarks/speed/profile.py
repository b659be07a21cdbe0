"""Shows where the time of a training step goes on a CPU, beside the processor's rate of arithmetic.

    python -m benchmarks.speed.profile student
    python -m benchmarks.speed.profile retriever --avx2

The script trains the tiny model with our trainer: one step that is not measured, one whose
floating-point operations are counted, three that are timed, and one that is profiled. For each
timed step, it prints the operations per second, and their share of the rate of one large matrix
product that the process computes after the step. Then it prints the share of each kind of operation
in the time of the profiled step.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode
from transformers import Trainer, TrainerCallback

from benchmarks.speed import comparison, contrastive, sft
from benchmarks.speed.comparison import AVX2, Measurements, run_in_process
from dynapix.conf.failures import report_failures
from dynapix.models.resolved_settings import resolve_precision

COUNTED, TIMED, PROFILED = 2, (3, 4, 5), 6
"""Numbers of the steps, from 1."""
TRAIN = comparison.train
LARGE = 2048
"""Rows and columns of the large product."""
KINDS = {
    "matrix products": ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm", "mkldnn_linear"),
    "attention": ("scaled_dot_product", "flash_attention"),
    "convolutions": ("convolution",),
    "softmax and norms": ("softmax", "norm", "aten::mean", "aten::rsqrt"),
    "copies and casts": ("aten::copy_", "aten::cat", "aten::index", "aten::clone"),
    "elementwise": ("aten::mul", "aten::add", "aten::sub", "aten::div", "silu", "gelu", "aten::sum",
                    "aten::neg", "aten::fill_", "aten::pow"),
}  # fmt: skip
"""Parts of the names of operations, by kind. The first kind that fits counts."""


class StepProfile(TrainerCallback):
    """Counts the operations of one step, times others, and profiles the last one."""

    def __init__(self, dtype: torch.dtype) -> None:
        self._dtype = dtype
        self.counter = FlopCounterMode(display=False)
        self.profiler = profile(activities=[ProfilerActivity.CPU])
        self.seconds: list[float] = []
        self.limits: list[float] = []
        self._stack = ExitStack()
        self._start = 0.0

    def on_step_begin(self, _: Any, state: Any, *rest: Any, **__: Any) -> None:
        step = state.global_step + 1
        if step in (COUNTED, PROFILED):
            self._stack.enter_context(self.counter if step == COUNTED else self.profiler)

    def on_step_end(self, _: Any, state: Any, *rest: Any, **__: Any) -> None:
        self._stack.close()
        if state.global_step in TIMED:
            self.seconds.append(time.perf_counter() - self._start)
            # The processor's rate changes with other programs, so each step has its own limit.
            self.limits.append(large_product_rate(self._dtype))
        self._start = time.perf_counter()


def profile_training(trainer: Trainer, batch: int) -> Measurements:
    """Train as `comparison.train` does, and print the profile."""
    steps = StepProfile(torch.bfloat16 if trainer.args.bf16 else torch.float32)
    trainer.add_callback(steps)
    measured = TRAIN(trainer, batch)
    operations = steps.counter.get_total_flops()
    for seconds, limit in zip(steps.seconds, steps.limits, strict=True):
        print(
            f"{batch / seconds:.1f} samples or queries a second: {operations / seconds / 1e9:.0f} "
            f"GFLOP/s, {operations / seconds / limit:.0%} of one large product's"
        )
    shares = defaultdict(float)
    for event in steps.profiler.key_averages():
        kind = next((k for k, parts in KINDS.items() if any(p in event.key for p in parts)), "rest")
        shares[kind] += event.self_cpu_time_total
    for kind, share in sorted(shares.items(), key=lambda item: -item[1]):
        print(f"{100 * share / sum(shares.values()):5.1f}%  {kind}")
    return measured


def large_product_rate(dtype: torch.dtype) -> float:
    """Return the floating-point operations per second of one large product."""
    one, other = torch.randn(2, LARGE, LARGE).to(dtype)
    seconds = []
    for _ in range(6):
        start = time.perf_counter()
        one @ other
        seconds.append(time.perf_counter() - start)
    return 2 * LARGE**3 / min(seconds)


def profile_model(model: str, precision: str, store: str) -> None:
    """Profile the training of the tiny model in this process."""
    settings = [f"store={store}", f"train.precision={precision}"]
    with patch.object(comparison, "train", profile_training):
        if model == "student":
            settings += ["+exp=cot", "train.generated_items=0"]
            sft.measure(settings, sft.Variant(), PROFILED - 1, False)
        else:
            contrastive.measure(settings, contrastive.Variant(), PROFILED - 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", choices=["student", "retriever"])
    parser.add_argument("--avx2", action="store_true", help="fp32, as on an older processor")
    parser.add_argument("--store", default="store", help="folder of the built benchmarks")
    args = parser.parse_args()
    precision = "fp32" if args.avx2 else resolve_precision("auto")
    environment = {"KINETO_LOG_LEVEL": "5", **(AVX2 if args.avx2 else {})}
    run_in_process(profile_model, args.model, precision, args.store, environment=environment)


if __name__ == "__main__":
    with report_failures():
        main()
