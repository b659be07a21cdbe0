"""Compares the student trainer with TRL's SFTTrainer (extra `rl`) in speed and memory.

    python -m benchmarks.speed.sft                # the tiny student, on any machine
    python -m benchmarks.speed.sft qwen3_vl_8b    # a released size, on a GPU
    python -m benchmarks.speed.sft --losses

Every variant trains on the same samples of the tiny benchmark in each step, with the same base and
hyperparameters, in a process of its own. The samples of TRL's steps are sorted by length. The
script prints medians over the rounds and the ratios to our trainer with the preset's settings. A
released size has random weights, so that nothing is downloaded. Losses of our trainer and of TRL
are not comparable here, because each uses its own convention.

TRL runs with its default settings, and with each setting that could make it faster. Among these are
the MALLOC_* environment variables, which have the effect of our trainer's calls of mallopt. TRL
uses our collator, because its own does not support videos. TRL casts adapters over 4-bit weights to
bf16. If TRL is not installed, only our trainer is measured.

`--losses` compares the losses of all steps instead, in fp32 with a base that is not quantised. Our
trainer then uses TRL's convention: the mean over the tokens of a micro-batch, then over
micro-batches.
"""

from __future__ import annotations

import argparse
import importlib.util
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Subset
from transformers import ProcessorMixin, Trainer, set_seed

from benchmarks.speed import comparison
from benchmarks.speed.comparison import MALLOC, OURS, SEED, Measurements, timing_arguments
from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.runs import Run
from dynapix.conf.schema import SftCommand
from dynapix.data.build import ensure_benchmark
from dynapix.models import compat, loading
from dynapix.models.layers.attention import flash_attention
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.models.student.collator import Collator, encode, pad
from dynapix.models.student.prompts import Sample
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.student.dataset import load_datasets, tokenizer_corpus
from dynapix.train.student.samples import LengthSampler
from dynapix.train.student.trainer import build_trainer, token_mean


@dataclass(frozen=True)
class Variant:
    """A trainer and its settings."""

    overrides: tuple[str, ...] = ()
    """Settings of `train` that differ from the preset."""
    trl: bool = False
    """Train with TRL instead of our trainer."""
    flash: bool = False
    """Let TRL use flash attention if it is installed."""
    environment: dict[str, str] = field(default_factory=dict)


DEFAULT = "TRL, default settings"
KEPT, RECOMPUTED = "gradient_checkpointing=false", "gradient_checkpointing=true"
TRL_SETTINGS = ("workers=0", "micro_batch=8", KEPT)
VARIANTS = {
    OURS: Variant(),
    "ours, without reused features": Variant(("reuse_features=false",)),
    "ours, activations kept": Variant((KEPT,)),
    "ours, activations recomputed": Variant((RECOMPUTED,)),
    "ours, micro-batch 1": Variant(("micro_batch=1",)),
    "ours, micro-batch 4": Variant(("micro_batch=4",)),
    "ours, micro-batch 8": Variant(("micro_batch=8",)),
    "ours, 4 workers": Variant(("workers=4",)),
    DEFAULT: Variant((*TRL_SETTINGS, RECOMPUTED), trl=True),
    "TRL, kept": Variant(TRL_SETTINGS, trl=True),
    "TRL, kept, 4": Variant((*TRL_SETTINGS, "micro_batch=4"), trl=True),
    "TRL, kept, 4 workers": Variant((*TRL_SETTINGS, "workers=4"), trl=True),
    "TRL, kept, flash attention": Variant(TRL_SETTINGS, trl=True, flash=True),
    "TRL, kept, MALLOC_*": Variant(TRL_SETTINGS, trl=True, environment=MALLOC),
    "TRL, kept, 4, MALLOC_*": Variant(
        (*TRL_SETTINGS, "micro_batch=4"), trl=True, environment=MALLOC
    ),
}
"""Variants by name. "kept": activations are not recomputed. "4": micro-batches of 4, not 8."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--losses", action="store_true", help="compare losses instead")
    comparison.add_arguments(parser, steps=8, variants=VARIANTS)
    args = comparison.parse_arguments(parser)
    has_trl = importlib.util.find_spec("trl") is not None
    if args.losses and not has_trl:
        parser.error("--losses needs TRL: pip install -e '.[rl]'")
    if args.losses:
        args.precision, args.quantization = "fp32", "none"
    overrides = list_overrides(args)
    with tempfile.TemporaryDirectory() as folder:
        if args.preset != "tiny":
            comparison.run_in_process(write_base, overrides, args.preset, Path(folder))
            overrides.append(f"student.model={folder}")
        if args.losses:
            compare_losses(overrides, args.steps)
        else:
            names = [name for name, variant in VARIANTS.items() if has_trl or not variant.trl]
            comparison.compare(
                lambda name: measure_in_process(overrides, VARIANTS[name], args.steps),
                args.only or names,
                OURS,
                "samples",
                args,
            )


def list_overrides(args: argparse.Namespace) -> list[str]:
    """Return the settings of train.sft that the options of a comparison determine."""
    return [
        "+exp=cot", "train.generated_items=0", f"student={args.preset}", f"store={args.store}",
        f"student.quantization={args.quantization}",
        f"train.precision={args.precision}",
    ]  # fmt: skip


def compare_losses(overrides: list[str], steps: int) -> None:
    # TRL's loss depends on the micro-batch, so both trainers use the same micro-batch.
    ours = measure_in_process(overrides, Variant(TRL_SETTINGS), steps, True)
    theirs = measure_in_process(overrides, Variant(TRL_SETTINGS, trl=True), steps, True)
    print(f"{'step':>4}{'ours':>12}{'TRL':>12}{'difference':>12}")
    for step, (loss, other) in enumerate(zip(ours.losses, theirs.losses, strict=True), 1):
        print(f"{step:>4}{loss:>12.6f}{other:>12.6f}{abs(loss - other):>12.1e}")


def measure_in_process(
    overrides: list[str], variant: Variant, steps: int, same_micro_batches: bool = False
) -> Measurements:
    return comparison.run_in_process(
        measure, overrides, variant, steps, same_micro_batches, environment=variant.environment
    )


def measure(
    overrides: list[str], variant: Variant, steps: int, same_micro_batches: bool
) -> Measurements:
    """Train a variant in this process for `steps` steps after the first one.

    Args:
        same_micro_batches: Whether the trainers are to have the same micro-batches and TRL's loss.
            Otherwise, TRL gets the samples of a step sorted by length, and thus has less padding.
    """
    changes = [f"train.{change}" for change in variant.overrides]
    cfg = compose("train.sft", SftCommand, [*overrides, *changes, f"train.max_steps={steps + 1}"])
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    rationales = ensure_rationales(store, cfg.teacher)
    if not variant.trl:
        compat.keep_freed_memory()
    set_seed(SEED)
    model, processor = loading.load_student(cfg.student, cfg.train.precision, list)
    training, validation = load_datasets(cfg, store, rationales)
    with tempfile.TemporaryDirectory() as folder:
        if variant.trl:
            lengths = training.lengths(processor, cfg.student.image_size)
            order = LengthSampler(
                lengths, training.item_ids, cfg.train.batch, cfg.seed, pairs=same_micro_batches
            )
            samples = Subset(training, list(islice(order, (steps + 1) * cfg.train.batch)))
            trainer = build_trl_trainer(cfg, model, processor, samples, Path(folder), variant.flash)
        else:
            use_fast_layers(model)
            run = Run("benchmark", Path(folder))
            trainer = build_trainer(cfg, run, model, processor, training, validation, None)
            if same_micro_batches:
                micro_batches = cfg.train.batch // cfg.train.micro_batch
                trainer.compute_loss_func = partial(mean_of_means, micro_batches)
        return comparison.train(trainer, cfg.train.batch)


def mean_of_means(
    micro_batches: int, outputs: Any, labels: torch.Tensor, num_items_in_batch: Any = None
) -> torch.Tensor:
    """Return a micro-batch's share of TRL's loss: the mean of the token means of micro-batches."""
    return token_mean(outputs, labels) / micro_batches


def build_trl_trainer(
    cfg: SftCommand,
    model: torch.nn.Module,
    processor: ProcessorMixin,
    samples: Subset,
    folder: Path,
    flash: bool,
) -> Trainer:
    """Return TRL's trainer with our hyperparameters; its other settings have TRL's defaults.

    TRL accepts only a dataset of the `datasets` library, so the dataset contains sample indices and
    the collator looks up the samples.
    """
    import datasets
    from trl import SFTConfig, SFTTrainer

    train = cfg.train
    attention = flash_attention(train.precision) if flash else None
    model.get_base_model().set_attn_implementation(attention or "sdpa")
    collator = FullCollator(processor, cfg.student.max_length)
    return SFTTrainer(
        model=model,
        args=SFTConfig(
            # Older releases of transformers name the first setting like the second one.
            **timing_arguments(replace(train, gradient_checkpointing=False), folder)
            | {"gradient_checkpointing": train.gradient_checkpointing},
            per_device_train_batch_size=train.micro_batch,
            gradient_accumulation_steps=train.batch // train.micro_batch,
            train_sampling_strategy="sequential",
            # TRL's default of 1,024 tokens would cut an image.
            max_length=cfg.student.max_length,
            dataset_kwargs={"skip_prepare_dataset": True},
        ),
        data_collator=partial(collator.collate_rows, samples),
        train_dataset=datasets.Dataset.from_dict({"row": range(len(samples))}),
        processing_class=processor,
    )


class FullCollator(Collator):
    """Makes batches with labels at every position, as TRL requires."""

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length) for s in samples]
        return pad(encoded, self._processor.tokenizer.pad_token_id)

    def collate_rows(self, samples: Subset, rows: Sequence[dict[str, int]]) -> dict[str, Any]:
        """Collate the samples whose indices are in `rows`."""
        return self([samples[row["row"]] for row in rows])


def write_base(overrides: list[str], preset: str, folder: Path) -> None:
    """Save a base of a preset's size, with random weights and a tokenizer for the benchmark."""
    cfg = compose("train.sft", SftCommand, overrides)
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    texts = tokenizer_corpus(store, ensure_rationales(store, cfg.teacher))
    comparison.write_random_base(preset, texts, cfg.student.image_size, folder)


if __name__ == "__main__":
    with report_failures():
        main()
