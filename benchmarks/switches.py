"""What each of the trainer's switches of memory and speed is worth, on and off, in one run.

    python -m benchmarks.switches tiny
    python -m benchmarks.switches qwen3_vl_8b

Every line trains `--steps` steps of the same samples, those of the tiny benchmark with the template
teacher's rationales, by `train.sft`'s own trainer, collator and order, and gives the median step
and the most memory that the steps held on top of the loaded student (on a CPU, that the process
grew by). The first line is the settings that the others change by one switch. Released models have
random weights of their true shapes, so nothing is fetched; the 8B takes 18 GB of free disk.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn
from transformers import PrinterCallback, ProgressCallback, TrainerCallback, TrainingArguments

from benchmarks.train_step import SHAPES, device_name, write_random
from conf.compose import compose
from conf.entry import Run
from conf.schema import SftCommand, SftTrainConfig
from data.build import ensure_benchmark
from data.frames import Frames
from teacher.narrate import ensure_rationales
from train import backbone, loop, memory, samples
from train.collate import IGNORED, Collator, letter_ids
from train.conversation import Sample
from train.features import Features, Keyed
from train.planned import ByLength, Samples
from train.room import peak, start_peak
from train.sft_trainer import LetterChoice, StudentTrainer, token_mean
from train.tiny import build_processor

WARM_UP = 1
"""Steps before those that count."""


class AllRows(Collator):
    """A collator by which every position passes the head, supervised or not."""

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        batch = super().__call__(samples)
        labels = torch.full_like(batch["input_ids"], IGNORED)
        labels[:, batch.pop("logits_to_keep")] = batch["labels"]
        return {**batch, "labels": labels}


class StepTimes(TrainerCallback):
    """Seconds of each step with the making of its samples, and its memory from the warm-up on."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.seconds: list[float] = []

    def on_train_begin(self, *_: Any, **__: Any) -> None:
        self._held = start_peak(self._device)
        self._last = time.perf_counter()

    def on_step_end(self, *_: Any, **__: Any) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        now = time.perf_counter()
        self.seconds.append(now - self._last)
        self._last = now

    def median(self) -> float:
        return statistics.median(self.seconds[WARM_UP:])

    def bytes(self) -> int:
        return peak(self._device) - self._held


@dataclass
class Bench:
    """A loaded student and what it is trained on."""

    cfg: SftCommand
    model: nn.Module
    collator: Collator
    letters: list[int]
    training: Samples
    lengths: list[int]
    steps: int
    device: torch.device

    def line(self, name: str, train: SftTrainConfig, collator: Any, features: Any = None) -> None:
        """Train some steps and print what they took."""
        times = StepTimes(self.device)
        memory.switch(self.model, False)
        with tempfile.TemporaryDirectory() as folder:
            trainer = StudentTrainer(
                model=self.model,
                args=TrainingArguments(
                    **{
                        **loop.arguments(train, Run("switches", Path(folder)), 0, None),
                        "max_steps": WARM_UP + self.steps,
                        "eval_strategy": "no",
                        "eval_on_start": False,
                        "save_strategy": "no",
                        "disable_tqdm": True,
                    },
                    per_device_train_batch_size=train.micro_batch,
                    gradient_accumulation_steps=train.batch // train.micro_batch,
                    dataloader_prefetch_factor=loop.prefetched(
                        train.workers, train.batch // train.micro_batch
                    ),
                    label_names=["labels"],
                ),
                data_collator=collator,
                train_dataset=self.training,
                compute_loss_func=token_mean,
                callbacks=[times],
                order=ByLength(self.lengths, train.batch, 0),
                choice=LetterChoice(self.letters),
                features=features,
            )
            trainer.remove_callback(ProgressCallback)
            trainer.remove_callback(PrinterCallback)
            try:
                trainer.train()
            except torch.OutOfMemoryError:
                print(f"{name:<44}{'out of memory':>32}", flush=True)
                return
        seconds = times.median()
        print(
            f"{name:<44}{seconds:>10.3f}{train.batch / seconds:>12.2f}"
            f"{times.bytes() / 2**30:>10.2f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the trainer's switches.")
    parser.add_argument("student", choices=["tiny", *SHAPES])
    parser.add_argument("--steps", type=int, default=5, help="timed steps a line, after one")
    parser.add_argument("--store", default="store", help="where the tiny benchmark is or is built")
    args = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        bench = loaded(args.student, Path(args.store), args.steps, Path(folder))
    print(f"{args.student} on {device_name(bench.device)}, {bench.cfg.train.batch} samples a step")
    print(f"{'':<44}{'s/step':>10}{'samples/s':>12}{'GiB':>10}")
    measure(bench)


def loaded(name: str, store: Path, steps: int, folder: Path) -> Bench:
    cfg = compose("train.sft", SftCommand, [f"student={name}", "+exp=cot"])
    built = ensure_benchmark(cfg.benchmark, store, cfg.workers)
    rationales = ensure_rationales(built, cfg.teacher)
    backbone.keep_big_blocks()
    torch.manual_seed(0)
    if name in SHAPES:
        write_random(name, cfg.student, folder)
        texts = samples.corpus(built, rationales)
        build_processor(texts, 1024, cfg.student.image_size).save_pretrained(folder)
        cfg = replace(cfg, student=replace(cfg.student, model=str(folder)))
    model, processor = backbone.load_student(cfg.student, cfg.train.precision, list)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    frames = Frames(built, cfg.student.image_size)
    training, _ = samples.splits(built, rationales, cfg, frames)
    return Bench(
        cfg=cfg,
        model=model.to(device),
        collator=Collator(processor, cfg.student.max_length),
        letters=letter_ids(processor),
        training=training,
        lengths=training.lengths(processor.tokenizer, cfg.student.image_size),
        steps=steps,
        device=device,
    )


def measure(bench: Bench) -> None:
    """The preset with activations kept, and then each switch by itself."""
    preset = replace(bench.cfg.train, gradient_checkpointing=False, workers=0)
    collator = bench.collator
    order = list(ByLength(bench.lengths, preset.batch, 0))
    for k in order[: (WARM_UP + bench.steps) * preset.batch]:
        # The frames' own cache would count as memory of the first line.
        bench.training[k]
    bench.line(f"micro-batch {preset.micro_batch}, activations kept", preset, collator.named)
    recomputed = replace(preset, gradient_checkpointing=True)
    bench.line("activations recomputed", recomputed, collator.named)
    for size in memory.sizes(preset.batch):
        if size != preset.micro_batch:
            bench.line(f"micro-batch {size}", replace(preset, micro_batch=size), collator.named)
    rows = AllRows(collator._processor, bench.cfg.student.max_length)
    bench.line("every position passes the head", preset, rows.named)
    features = Features.of(bench.model, preset)
    bench.line("features kept, shown for the first time", preset, Keyed(collator), features)
    name = f"features kept, shown again ({features.bytes / 2**30:.2f} GiB)"
    bench.line(name, preset, Keyed(collator), features)
    for workers in (1, 2, 4):
        bench.line(f"workers {workers}", replace(preset, workers=workers), collator.named)
    auto = replace(preset, micro_batch="auto", gradient_checkpointing="auto")
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        arguments = (Path(folder), bench.model, collator, bench.training, bench.lengths)
        chosen = memory.settle(auto, *arguments)
        seconds = time.perf_counter() - started
    kept = "recomputed" if chosen.gradient_checkpointing else "kept"
    name = f"auto: micro-batch {chosen.micro_batch}, {kept}, found in {seconds:.0f} s"
    bench.line(name, chosen, collator.named)


if __name__ == "__main__":
    main()
