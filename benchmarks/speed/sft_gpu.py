"""The student's trainer beside TRL's SFTTrainer at the released sizes, setting by setting: samples
per second, peak memory and the share of the card's bf16 peak.

    python -m benchmarks.speed.sft_gpu qwen3_vl_8b --base nf4
    python -m benchmarks.speed.sft_gpu tiny       # a small version for any machine

Weights have the released model's shape and random values, so nothing is downloaded. All other
settings are the preset's: adapters, frames, a step of 16 samples, half of them rationales of 80 to
250 words, half answers. The peak is the rate of the machine's own matrix products in the same run.
Only necessary passes count as work: no padding, no recomputation, no unsupervised rows of the head.
Without TRL only our trainer is measured; PYTHONPATH may name a folder that contains it. The rate of
the preset's own settings is recorded for benchmarks.speed.hours if a GPU measured it.
"""

from __future__ import annotations

import argparse
import gc
import importlib.util
import json
import logging
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bitsandbytes as bnb
import numpy as np
import torch
from torch import nn
from torch.utils.data import Subset
from torch.utils.flop_counter import FlopCounterMode
from transformers import ProcessorMixin, Qwen3VLConfig, Qwen3VLForConditionalGeneration, set_seed

from benchmarks.speed import hours
from benchmarks.speed.sft_runs import SEED, Figures, Student, Variant, device_name, train
from conf.compose import compose
from conf.errors import UserError
from conf.schema import SftCommand, StudentConfig
from data.records import LETTERS
from models import compat, loading, parameter_counts
from models.attention import choose_attention, flash_attention
from models.student.collator import Collator
from models.student.prompts import Clip, Sample, answer_line, conversation, instruction
from models.tiny_qwen3_vl import SPECIAL_TOKENS, build_processor
from train.student.trainer import token_mean

ROOT = Path(__file__).parents[2]
CONFIGS = {
    "tiny": ROOT / "checkpoints/bases/tiny/config.json",
    "qwen3_vl_2b": ROOT / "tests/models/configs/qwen3_vl_2b.json",
    "qwen3_vl_8b": ROOT / "tests/models/configs/qwen3_vl_8b.json",
}
WORDS = "the blue metal cube near the top moves quickly toward the west and will be very close"
SHORTEST, LONGEST = 80, 250
"""The range of a rationale's length in words."""


def variants() -> list[Variant]:
    """Ours with one setting changed at a time, and TRL with the settings that could help it."""
    ours = [
        Variant("ours, activations kept", micro_batch=1),
        Variant("  micro-batch 4", micro_batch=4, packing="false"),
        Variant("  micro-batch 4, packed", micro_batch=4, packing="true"),
        Variant("  the library's attention (sdpa)", micro_batch=1, attention="sdpa"),
        Variant("  every row passes through the head", micro_batch=1, every_row=True),
        Variant("  vision features reused", micro_batch=1, reuse=True),
        Variant("  4 workers", micro_batch=1, workers=4),
        Variant("  micro-batch 4, 4 workers", micro_batch=4, packing="false", workers=4),
    ]
    trl = [
        Variant("TRL, activations kept", "trl", micro_batch=1),
        Variant("  micro-batch 4", "trl", micro_batch=4),
        Variant("  micro-batch 4, 4 workers", "trl", micro_batch=4, workers=4),
        Variant("  micro-batch 8, 4 workers", "trl", micro_batch=8, workers=4),
    ]
    if (flash := flash_attention("bf16")) is not None:
        name = f"  micro-batch 4, 4 workers, {flash}"
        trl.append(Variant(name, "trl", micro_batch=4, workers=4, attention=flash))
    # Recomputation leaves hooks in the embeddings, so these variants come last.
    ours_last = [Variant("ours, activations recomputed", micro_batch=1, recompute=True)]
    trl_last = [Variant("TRL, default (micro-batch 8, recomputed)", "trl", recompute=True)]
    if importlib.util.find_spec("trl") is None:
        return ours + ours_last
    return ours + trl + ours_last + trl_last


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("student", choices=list(CONFIGS))
    parser.add_argument("--base", choices=["nf4", "bf16"], action="append", help="default: both")
    parser.add_argument("--steps", type=int, default=4, help="timed steps after a first one")
    args = parser.parse_args()
    warnings.simplefilter("ignore", FutureWarning)
    logging.disable(logging.WARNING)
    if torch.cuda.device_count() > 1:
        parser.error("this measures one GPU: set CUDA_VISIBLE_DEVICES=0")
    compat.keep_freed_memory()
    for base in args.base or ["nf4", "bf16"]:
        measure(args.student, base, args.steps)


def measure(name: str, base: str, steps: int) -> None:
    settings = compose("train.sft", SftCommand, [f"student={name}", "+exp=cot"])
    student, device = settings.student, torch.device("cuda" if torch.cuda.is_available() else "cpu")
    student.quantization = "nf4" if base == "nf4" else "none"
    set_seed(SEED)
    model, processor = build_student(name, student, device)
    samples = noise_samples(student, settings.train.batch)
    order = list(range(len(samples))) * (steps + 1)
    subject = Student(model, processor, Subset(samples, order), settings.train, student.max_length)
    flops = step_flops(model, processor, samples, student)
    bench = Bench(subject, student, flops, product_rate(device))
    print(f"\n{name} over {base} on {device_name()}, {bench.limit / 1e12:.1f} TFLOP/s")
    print(parameter_counts.format_towers(parameter_counts.count_towers(model)))
    print(f"{len(samples)} samples a step, {bench.flops / 1e12:.1f} TFLOP")
    print(f"{'':<48}{'s/step':>9}{'samples/s':>11}{'of peak':>9}{'peak GiB':>10}", flush=True)
    times = [(variant.trainer, bench.measure(variant, steps)) for variant in variants()]
    preset = Variant(
        "ours, the preset's settings",
        micro_batch=settings.train.micro_batch,
        recompute=settings.train.gradient_checkpointing,
    )
    own = bench.measure(preset, steps)
    if own is not None and device.type == "cuda":
        hours.add("sft_gpu", name, base, settings.train.batch / own, device_name())
    times.append(("ours", own))
    fastest = {
        trainer: min((s for by, s in times if by == trainer and s is not None), default=None)
        for trainer in ("ours", "trl")
    }
    if None in fastest.values():
        missing = [trainer for trainer, seconds in fastest.items() if seconds is None]
        print(f"no ratio: no variant of {' or '.join(missing)} ran")
    else:
        print(f"ours at best {fastest['trl'] / fastest['ours']:.2f} times TRL at best")


@dataclass
class Bench:
    """Measures variants of a student's training.

    Attributes:
        flops: The FLOP of a step's necessary passes.
        limit: The FLOP/s of the machine's own matrix products.
    """

    subject: Student
    student: StudentConfig
    flops: float
    limit: float

    def __post_init__(self) -> None:
        trained = dict(self.subject.model.named_parameters())
        self._adapters = {n: p.detach().clone() for n, p in trained.items() if p.requires_grad}

    def measure(self, variant: Variant, steps: int) -> float | None:
        """Train some steps, print the measurements and return the median seconds of a step."""
        self.reset()
        figures = self.train(variant, steps)
        if isinstance(figures, str):
            print(f"{variant.name:<48}{figures}", flush=True)
            return None
        seconds = statistics.median(figures.seconds)
        print(
            f"{variant.name:<48}{seconds:>9.3f}{self.subject.train.batch / seconds:>11.2f}"
            f"{self.flops / seconds / self.limit:>9.1%}{figures.peak:>10.2f}",
            flush=True,
        )
        return seconds

    def train(self, variant: Variant, steps: int) -> Figures | str:
        """The measurements, or the reason why the variant cannot train."""
        try:
            with tempfile.TemporaryDirectory() as folder:
                return train(variant, self.subject, steps + 1, Path(folder))
        except torch.OutOfMemoryError:
            return "out of memory"
        except UserError as error:
            return str(error)

    def reset(self) -> None:
        """Restore the student: TRL casts its adapters to bf16 and replaces its forward."""
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        model = self.subject.model
        base = model.get_base_model()
        for name, parameter in model.named_parameters():
            parameter.grad = None
            if name in self._adapters:
                parameter.data = self._adapters[name].clone()
        vars(base).pop("forward", None)
        choose_attention(base, "bf16", self.student.max_length)


def build_student(
    name: str, cfg: StudentConfig, device: torch.device
) -> tuple[nn.Module, ProcessorMixin]:
    """A student of a released shape with random bf16 or 4-bit weights, and adapters."""
    model = random_model(name, cfg.quantization, device)
    model.config.use_cache = False
    compat.keep_differentiable(model)
    student = loading.add_adapters(model, cfg.lora).to(device)
    parameter_counts.check_towers(
        parameter_counts.count_towers(student), cfg.name, cfg.quantization, cfg.lora.rank
    )
    corpus = [instruction("reasoning", "cot"), *(answer_line(x) for x in LETTERS), WORDS]
    processor = build_processor(corpus * 20, 512, cfg.image_size)
    loading.pin_sizes(processor, cfg.image_size, cfg.frames)
    return student, processor


def random_model(
    name: str, quantization: str, device: torch.device
) -> Qwen3VLForConditionalGeneration:
    """A model of a released shape with random bf16 or 4-bit weights and the tiny tokenizer's
    special tokens."""
    config = Qwen3VLConfig.from_dict(json.loads(CONFIGS[name].read_text()))
    for key, token in (
        ("image_token_id", "<|image_pad|>"),
        ("video_token_id", "<|video_pad|>"),
        ("vision_start_token_id", "<|vision_start|>"),
        ("vision_end_token_id", "<|vision_end|>"),
    ):
        setattr(config, key, SPECIAL_TOKENS.index(token))
    kept = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        with device:
            model = Qwen3VLForConditionalGeneration(config)
    finally:
        torch.set_default_dtype(kept)
    if quantization == "nf4":
        quantise(model)
    return model


def quantise(model: nn.Module) -> None:
    """Quantise the language tower's linear layers to NF4 in place."""
    for name, linear in list(model.named_modules()):
        if not isinstance(linear, nn.Linear) or not name.startswith("model.language_model.layers."):
            continue
        size = linear.in_features, linear.out_features
        four = bnb.nn.Linear4bit(
            *size, bias=False, compute_dtype=torch.bfloat16, quant_type="nf4", device="meta"
        )
        four.weight = bnb.nn.Params4bit(
            linear.weight.data, requires_grad=False, quant_type="nf4", module=four
        )
        model.set_submodule(name, four.to(linear.weight.device))
    # peft and TRL read this flag, which the library's own loading sets.
    model.is_loaded_in_4bit = True


def noise_samples(cfg: StudentConfig, count: int) -> list[Sample]:
    """Conversations with frames of noise, longest first: half with a rationale, half with an answer
    only."""
    rng = np.random.default_rng(SEED)
    words = np.linspace(LONGEST, SHORTEST, count // 2).astype(int)
    size = (cfg.frames + len(LETTERS), cfg.image_size, cfg.image_size, 3)
    samples = []
    for length in [*words, *[0] * (count - len(words))]:
        pixels = rng.integers(0, 256, size, dtype=np.uint8)
        mode = "reasoning" if length else "answer"
        parts: list[str | np.ndarray] = []
        for letter, candidate in zip(LETTERS, pixels[cfg.frames :], strict=True):
            parts += [f"\nCandidate {letter}: ", candidate]
        text = " ".join((WORDS.split() * LONGEST)[:length])
        samples.append(
            conversation(
                f"noise {len(samples)}",
                [*parts, f"\n{instruction(mode, 'cot')}"],
                f"{text}\n{answer_line(LETTERS[0])}".strip(),
                Clip(pixels[: cfg.frames], list(range(cfg.frames))),
            )
        )
    return samples


def step_flops(
    model: nn.Module, processor: ProcessorMixin, samples: list[Sample], cfg: StudentConfig
) -> int:
    """FLOP of the passes over a step's samples, one by one and with activations kept."""
    collator = Collator(processor, cfg.max_length)
    device = next(model.parameters()).device
    # The counter does not see the kernels of flash attention.
    model.get_base_model().set_attn_implementation("sdpa")
    model.train()
    with FlopCounterMode(display=False) as counter, torch.autocast(device.type, torch.bfloat16):
        for sample in samples:
            batch = {name: value.to(device) for name, value in collator([sample]).items()}
            labels = batch.pop("labels")
            token_mean(model(**batch), labels).backward()
    return counter.get_total_flops()


def product_rate(device: torch.device) -> float:
    """FLOP/s of this machine's own bf16 matrix products."""
    size = 8192 if device.type == "cuda" else 2048
    left = torch.randn(size, size, device=device, dtype=torch.bfloat16)
    return 2 * size**3 / median_time(lambda: left @ left, device)


def median_time(product: Callable[[], object], device: torch.device) -> float:
    """Median seconds of ten calls, after two warm-up calls."""
    times = []
    for k in range(12):
        started = time.perf_counter()
        product()
        if device.type == "cuda":
            torch.cuda.synchronize()
        if k >= 2:
            times.append(time.perf_counter() - started)
    return statistics.median(times)


if __name__ == "__main__":
    main()
