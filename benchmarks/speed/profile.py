"""Shows where the time of a training step goes on a CPU, beside the processor's rate of arithmetic.

    python -m benchmarks.speed.profile student
    python -m benchmarks.speed.profile retriever --avx2

The script profiles our trainer of the tiny models after its first step. It prints the share of the
time in each kind of operation and, for matrix products, their rate as a share of the rate of one
large product, which the same process measures.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from typing import Any
from unittest.mock import patch

import torch
from torch.profiler import ProfilerActivity, profile
from transformers import Trainer, TrainerCallback

from benchmarks.speed import comparison, contrastive, sft
from benchmarks.speed.comparison import AVX2, Measurements, run_in_process
from dynapix.conf.failures import report_failures
from dynapix.models.precision import resolve_precision

STEPS = 2
"""Profiled steps, after a first one."""
TRAIN = comparison.train
LARGE = 2048
"""Rows and columns of the large product."""
KINDS = {
    "matrix products": ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm", "mkldnn_linear"),
    "attention": ("scaled_dot_product", "flash_attention"),
    "convolutions": ("convolution",),
    "copies and casts": ("aten::copy_", "aten::cat", "aten::index", "aten::clone"),
    "softmax and norms": ("softmax", "norm", "aten::mean", "aten::rsqrt"),
}
"""Parts of the names of operations, by kind. The first kind that fits counts."""


class ProfiledSteps(TrainerCallback):
    """Profiles the steps after the first one."""

    def __init__(self) -> None:
        self.profiler = profile(activities=[ProfilerActivity.CPU], with_flops=True)
        self.seconds = 0.0

    def on_step_end(self, _: Any, state: Any, *rest: Any, **__: Any) -> None:
        if state.global_step == 1:
            self.profiler.start()
            self.seconds = -time.perf_counter()

    def on_train_end(self, *_: Any, **__: Any) -> None:
        self.seconds += time.perf_counter()
        self.profiler.stop()


def profile_training(trainer: Trainer, batch: int) -> Measurements:
    """Train as `comparison.train` does, and print the profile."""
    steps = ProfiledSteps()
    trainer.add_callback(steps)
    measured = TRAIN(trainer, batch)
    seconds, operations = defaultdict(float), defaultdict(float)
    for event in steps.profiler.key_averages():
        kind = next((k for k, parts in KINDS.items() if any(p in event.key for p in parts)), "")
        seconds[kind or "other operations"] += event.self_cpu_time_total / 1e6
        operations[kind] += event.flops
    print(f"{steps.seconds / STEPS:.1f} s a step, {measured.rate:.1f} a second")
    for kind, duration in sorted(seconds.items(), key=lambda item: -item[1]):
        print(f"{100 * duration / sum(seconds.values()):5.1f}%  {kind}")
    products = next(iter(KINDS))
    rate = operations[products] / seconds[products]
    limit = large_product_rate(torch.bfloat16 if trainer.args.bf16 else torch.float32)
    print(f"{products}: {rate / 1e9:.0f} GFLOP/s, one large product: {limit / 1e9:.0f} GFLOP/s")
    return measured


def large_product_rate(dtype: torch.dtype) -> float:
    """Return the operations per second of one large product."""
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
            sft.measure(settings, sft.Variant(), STEPS, False)
        else:
            contrastive.measure(settings, contrastive.Variant(), STEPS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", choices=["student", "retriever"])
    parser.add_argument("--avx2", action="store_true", help="fp32, as on an older processor")
    parser.add_argument("--store", default="store", help="folder of the built benchmarks")
    args = parser.parse_args()
    precision = "fp32" if args.avx2 else resolve_precision("auto")
    environment = AVX2 if args.avx2 else {}
    run_in_process(profile_model, args.model, precision, args.store, environment=environment)


if __name__ == "__main__":
    with report_failures():
        main()
