"""Compares on-policy distillation with supervised training in speed and memory.

    python -m benchmarks.speed.distill                # the tiny student, on any machine
    python -m benchmarks.speed.distill qwen3_vl_8b    # a released size, on a GPU

Every variant trains on items of the tiny benchmark, in a process of its own. "train.sft" trains on
its usual samples, half of which are answers without a rationale. "train.distill" samples a response
to each item and trains on it, with a teacher of the same size that reads the facts. Both have the
batch, the micro-batch and the memory settings of the student's preset. The script prints medians
over the rounds and the ratios to train.sft.

A released size has random weights, so that nothing is downloaded. Its responses do not end, so they
have the full length of --tokens.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from transformers import set_seed

from benchmarks.arguments import positive_int
from benchmarks.speed import comparison
from benchmarks.speed.comparison import SEED, Measurements
from benchmarks.speed.sft import VARIANTS as SFT_VARIANTS
from benchmarks.speed.sft import list_overrides, write_base
from benchmarks.speed.sft import measure as measure_sft
from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.runs import Run
from dynapix.conf.schema import DistillCommand, SftCommand
from dynapix.data.build import ensure_benchmark
from dynapix.models import compat, loading
from dynapix.models.distributed import rank_device
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.on_policy import distillation, sampling
from dynapix.train.on_policy.continuation import inherit_settings
from dynapix.train.on_policy.paired_prompts import load_datasets
from dynapix.train.on_policy.teachers import LocalTeacher

VARIANTS = SFT, DISTILL = "train.sft", "train.distill"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--tokens", type=positive_int, default=200, help="maximum length of a response"
    )
    comparison.add_arguments(parser, steps=3, variants=VARIANTS)
    args = comparison.parse_arguments(parser)
    overrides = [*list_overrides(args), f"student.max_new_tokens={args.tokens}"]
    with tempfile.TemporaryDirectory() as folder:
        if args.preset != "tiny":
            comparison.run_in_process(write_base, overrides, args.preset, Path(folder))
            overrides.append(f"student.model={folder}")
        comparison.compare(
            lambda name: comparison.run_in_process(measure, name, overrides, args.steps),
            args.only or VARIANTS,
            SFT,
            "samples",
            args,
        )


def measure(name: str, overrides: list[str], steps: int) -> Measurements:
    """Train a variant in this process for `steps` steps after the first one."""
    if name == SFT:
        return measure_sft(overrides, SFT_VARIANTS[comparison.OURS], steps, False)
    trained = compose("train.sft", SftCommand, overrides)
    cfg = compose("train.distill", DistillCommand, ["+exp=on_policy", f"store={trained.store}"])
    shared = {key: getattr(trained.train, key) for key in ("batch", "workers", "precision")}
    train = replace(cfg.train, **shared, max_steps=steps + 1, generated_items=0)
    cfg = inherit_settings(replace(cfg, train=train), trained)
    train = cfg.train
    store = ensure_benchmark(trained.benchmark, Path(cfg.store), trained.workers)
    rationales = ensure_rationales(store, trained.teacher)
    compat.keep_freed_memory()
    set_seed(SEED)
    student, processor = loading.load_student(trained.student, train.precision, list)
    use_fast_layers(student)
    training, validation = load_datasets(cfg, trained, store, rationales)
    # The responses of a model with random weights contain no answer.
    unlimited = patch.object(sampling.ResponseSampler, "check_parsed", lambda *_: None)
    with tempfile.TemporaryDirectory() as folder, unlimited:
        model, _ = loading.load_student(trained.student, train.precision, list)
        model.eval().to(rank_device())
        teacher = LocalTeacher(model, processor, train.precision == "bf16")
        run = Run("benchmark", Path(folder))
        trainer = distillation.build_trainer(
            cfg, trained, run, student, teacher, processor, training, validation, None
        )
        return comparison.train(trainer, train.batch)


if __name__ == "__main__":
    with report_failures():
        main()
