"""The student's trainer beside TRL's SFTTrainer at the released sizes, with each switch on and off:
samples a second, peak memory and the share of the card's bf16 peak, in one run.

    python -m benchmarks.speed.sft_gpu qwen3_vl_8b --base nf4
    python -m benchmarks.speed.sft_gpu tiny       # the same in small, on any machine

Weights are random, of the released model's shape, and made on the card, so nothing is fetched;
4-bit ones are quantised there. Everything else is the preset's: adapters, frames, a step of 16
samples, half of them rationales of 80 to 250 words, half answers. The peak is what the machine's
own matrix products reach in the same run; of a step only the passes that it needs count, none that
padding, recomputed activations or unsupervised rows of the head add. Where TRL is not installed,
ours is measured alone; PYTHONPATH may name a folder that holds it (pip install --no-deps --target).
The rate of what the trainer itself chooses is kept for benchmarks.speed.hours, where a card
measured it.
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
from benchmarks.speed.sft_runs import SEED, Figures, Variant, Work, device_name, run
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
SAID = "the blue metal cube near the top moves quickly toward the west and will be very close"
SHORTEST, LONGEST = 80, 250
"""Words of a rationale."""


def variants() -> list[Variant]:
    """Ours with one switch moved a line, and TRL as it comes and with all that could help it."""
    ours = [
        Variant("ours, activations kept", micro_batch=1),
        Variant("  micro-batch 4", micro_batch=4, packing="false"),
        Variant("  micro-batch 4, packed", micro_batch=4, packing="true"),
        Variant("  micro-batch 8", micro_batch=8, packing="false"),
        Variant("  the library's attention (sdpa)", micro_batch=1, attention="sdpa"),
        Variant("  every row passes the head", micro_batch=1, collator="every row"),
        Variant("  the frozen tower's features reused", micro_batch=1, reuse=True),
        Variant("  4 workers", micro_batch=1, workers=4),
        Variant("  micro-batch 4, 4 workers", micro_batch=4, packing="false", workers=4),
    ]
    trl = [
        Variant("TRL, activations kept", "trl", micro_batch=1),
        Variant("  4 workers", "trl", micro_batch=1, workers=4),
        Variant("  micro-batch 4", "trl", micro_batch=4),
        Variant("  micro-batch 4, 4 workers", "trl", micro_batch=4, workers=4),
        Variant("  micro-batch 8, 4 workers", "trl", micro_batch=8, workers=4),
    ]
    if (flash := flash_attention("bf16")) is not None:
        trl += [
            Variant(
                f"  micro-batch {size}, 4 workers, {flash}", "trl", size, False, 4, attention=flash
            )
            for size in (1, 4)
        ]
    # What recomputing hooks into the embeddings stays there, so those lines come last.
    ours_last = [Variant("ours, recomputed", micro_batch=1, recompute=True)]
    trl_last = [
        Variant("TRL as it comes (micro-batch 8, recomputed)", "trl", recompute=True),
        Variant("TRL, micro-batch 1, recomputed", "trl", micro_batch=1, recompute=True),
    ]
    if importlib.util.find_spec("trl") is None:
        return ours + ours_last
    return ours + trl + ours_last + trl_last


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("student", choices=list(CONFIGS))
    parser.add_argument(
        "--base", choices=["nf4", "bf16"], action="append", help="both, if not given"
    )
    parser.add_argument("--steps", type=int, default=4, help="timed steps a line, after one")
    args = parser.parse_args()
    warnings.simplefilter("ignore", FutureWarning)
    logging.disable(logging.WARNING)
    if torch.cuda.device_count() > 1:
        parser.error("one card is measured: set CUDA_VISIBLE_DEVICES=0")
    compat.keep_freed_memory()
    for base in args.base or ["nf4", "bf16"]:
        measure(args.student, base, args.steps)


def measure(name: str, base: str, steps: int) -> None:
    settings = compose("train.sft", SftCommand, [f"student={name}", "+exp=cot"])
    student, device = settings.student, torch.device("cuda" if torch.cuda.is_available() else "cpu")
    student.quantization = "nf4" if base == "nf4" else "none"
    set_seed(SEED)
    model, processor = built(name, student, device)
    shown = noise(student, settings.train.batch)
    places = list(range(len(shown))) * (steps + 1)
    work = Work(model, processor, Subset(shown, places), settings.train, student.max_length)
    bench = Bench(work, student, step_flops(model, processor, shown, student), product_rate(device))
    print(f"\n{name} over {base} on {device_name()}, {bench.limit / 1e12:.1f} TFLOP/s of products")
    print(parameter_counts.format_towers(parameter_counts.count_towers(model)))
    print(f"{len(shown)} samples a step, {bench.flops / 1e12:.1f} TFLOP")
    print(f"{'':<48}{'s/step':>9}{'samples/s':>11}{'of peak':>9}{'peak GiB':>10}", flush=True)
    found = [(variant.trainer, bench.line(variant, steps)) for variant in variants()]
    preset = Variant(
        "ours, as in the preset",
        micro_batch=settings.train.micro_batch,
        recompute=settings.train.gradient_checkpointing,
    )
    chosen = bench.line(preset, steps)
    if chosen is not None and device.type == "cuda":
        hours.add("sft_gpu", name, base, settings.train.batch / chosen, device_name())
    found.append(("ours", chosen))
    fastest = {
        trainer: min((s for by, s in found if by == trainer and s is not None), default=None)
        for trainer in ("ours", "trl")
    }
    if None in fastest.values():
        lacking = [trainer for trainer, seconds in fastest.items() if seconds is None]
        print(f"no line of {' or '.join(lacking)} was run, so there is no ratio")
    else:
        print(f"at its best {fastest['trl'] / fastest['ours']:.2f} times TRL's best")


@dataclass
class Bench:
    """A student, what a step of it takes (FLOP), and what the machine's products reach (FLOP/s)."""

    work: Work
    student: StudentConfig
    flops: float
    limit: float

    def __post_init__(self) -> None:
        trained = dict(self.work.model.named_parameters())
        self._adapters = {n: p.detach().clone() for n, p in trained.items() if p.requires_grad}

    def line(self, variant: Variant, steps: int) -> float | None:
        """Train some steps and print what they took; gives the median step's seconds."""
        self.renew()
        figures = self.trained(variant, steps)
        if isinstance(figures, str):
            print(f"{variant.name:<48}{figures}", flush=True)
            return None
        seconds = statistics.median(figures.seconds)
        print(
            f"{variant.name:<48}{seconds:>9.3f}{self.work.train.batch / seconds:>11.2f}"
            f"{self.flops / seconds / self.limit:>9.1%}{figures.peak:>10.2f}",
            flush=True,
        )
        return seconds

    def trained(self, variant: Variant, steps: int) -> Figures | str:
        """Figures, or what kept it from training."""
        try:
            with tempfile.TemporaryDirectory() as folder:
                return run(variant, self.work, steps + 1, Path(folder))
        except torch.OutOfMemoryError:
            return "out of memory"
        except UserError as error:
            return str(error)

    def renew(self) -> None:
        """The student as it was: TRL gives it bf16 adapters and a forward of its own."""
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        model = self.work.model
        base = model.get_base_model()
        for name, parameter in model.named_parameters():
            parameter.grad = None
            if name in self._adapters:
                parameter.data = self._adapters[name].clone()
        vars(base).pop("forward", None)
        choose_attention(base, "bf16", self.student.max_length)


def built(name: str, cfg: StudentConfig, device: torch.device) -> tuple[nn.Module, ProcessorMixin]:
    """A student of a released shape with random bf16 or 4-bit weights, and adapters."""
    model = random_model(name, cfg.quantization, device)
    model.config.use_cache = False
    compat.keep_differentiable(model)
    student = loading.add_adapters(model, cfg.lora).to(device)
    parameter_counts.check_towers(
        parameter_counts.count_towers(student), cfg.name, cfg.quantization, cfg.lora.rank
    )
    said = [instruction("reasoning", "cot"), *(answer_line(x) for x in LETTERS), SAID]
    processor = build_processor(said * 20, 512, cfg.image_size)
    loading.pin_sizes(processor, cfg.image_size, cfg.frames)
    return student, processor


def random_model(
    name: str, quantization: str, device: torch.device
) -> Qwen3VLForConditionalGeneration:
    """A model of a released shape with random bf16 or 4-bit weights, that knows the tiny
    tokenizer's special tokens."""
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
    """Make the language tower's linear layers NF4 where they are."""
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
    # What the library's own loading says to peft and TRL.
    model.is_loaded_in_4bit = True


def noise(cfg: StudentConfig, count: int) -> list[Sample]:
    """Conversations whose frames are noise, longest first: half end in a rationale, half in an
    answer alone."""
    rng = np.random.default_rng(SEED)
    words = np.linspace(LONGEST, SHORTEST, count // 2).astype(int)
    size = (cfg.frames + len(LETTERS), cfg.image_size, cfg.image_size, 3)
    made = []
    for length in [*words, *[0] * (count - len(words))]:
        pixels = rng.integers(0, 256, size, dtype=np.uint8)
        mode = "reasoning" if length else "answer"
        parts: list[str | np.ndarray] = []
        for letter, candidate in zip(LETTERS, pixels[cfg.frames :], strict=True):
            parts += [f"\nCandidate {letter}: ", candidate]
        said = " ".join((SAID.split() * LONGEST)[:length])
        made.append(
            conversation(
                f"noise {len(made)}",
                [*parts, f"\n{instruction(mode, 'cot')}"],
                f"{said}\n{answer_line(LETTERS[0])}".strip(),
                Clip(pixels[: cfg.frames], list(range(cfg.frames))),
            )
        )
    return made


def step_flops(
    model: nn.Module, processor: ProcessorMixin, samples: list[Sample], cfg: StudentConfig
) -> int:
    """FLOP of the passes over a step's samples, each alone and with activations kept."""
    collator = Collator(processor, cfg.max_length)
    device = next(model.parameters()).device
    # Flash attention's own kernels are not counted.
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
    """Median seconds of ten calls, after two that warm up."""
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
