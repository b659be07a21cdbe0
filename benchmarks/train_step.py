"""Time and memory of a student's training step at its real size, beside the matrix products that
the same machine does in the same run.

    python -m benchmarks.train_step qwen3_vl_8b
    python -m benchmarks.train_step tiny

Weights are random, of the released model's shape, so nothing is fetched; everything else is what
`train.sft` does: the preset's NF4 weights and adapters, its frames, a rationale of 250 words, one
sample a step, the loss on supervised tokens. It needs free disk for the weights in bf16 (18 GB for
the 8B).
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import Qwen3VLConfig, Qwen3VLForConditionalGeneration

from conf.compose import compose
from conf.schema import SftCommand, StudentConfig
from data.records import LETTERS
from train import backbone
from train.collate import Collator
from train.conversation import Clip, Sample, answer_line, conversation, instruction
from train.sft_trainer import token_mean
from train.tiny import SPECIAL_TOKENS, build_processor

VOCABULARY = 151_936
SHAPES = {
    "qwen3_vl_2b": {
        "text": {"hidden_size": 2048, "num_hidden_layers": 28, "num_attention_heads": 16,
                 "intermediate_size": 6144},
        "vision": {"depth": 24, "hidden_size": 1024, "intermediate_size": 4096,
                   "deepstack_visual_indexes": [5, 11, 17]},
        "tied": True,
    },
    "qwen3_vl_8b": {
        "text": {"hidden_size": 4096, "num_hidden_layers": 36, "num_attention_heads": 32,
                 "intermediate_size": 12_288},
        "vision": {"depth": 27, "hidden_size": 1152, "intermediate_size": 4304,
                   "deepstack_visual_indexes": [8, 16, 24]},
        "tied": False,
    },
}  # fmt: skip
"""Sizes of the released models, from their config.json; the rest is alike in both."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Time one training step of a student.")
    parser.add_argument("student", choices=["tiny", *SHAPES])
    parser.add_argument("--steps", type=int, default=10, help="timed steps, after two unmeasured")
    args = parser.parse_args()
    settings = compose("train.sft", SftCommand, [f"student={args.student}"])
    backbone.keep_big_blocks()
    with tempfile.TemporaryDirectory() as folder:
        cfg = settings.student
        if args.student in SHAPES:
            write_random(args.student, cfg, Path(folder))
            cfg = replace(cfg, model=folder)
        started = time.perf_counter()
        model, processor = backbone.load_student(cfg, settings.train.precision, list)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = model.to(device)
    print(
        f"{args.student} on {device_name(device)}, loaded in {time.perf_counter() - started:.0f} s"
    )
    print(backbone.tower_table(backbone.count_towers(model)))
    batch = Collator(processor, cfg.max_length)([sample(cfg)])
    batch = {name: value.to(device) for name, value in batch.items()}
    labels = batch.pop("labels")
    tokens = batch["input_ids"].numel()
    limit = product_rate(device)
    print(f"{tokens} tokens, {(labels >= 0).sum()} supervised")
    print(
        f"{'':<26}{'s/step':>10}{'tokens/s':>12}{'TFLOP/s':>10}{'of products':>13}{'peak GiB':>10}"
    )
    for recompute in (False, True):
        switch(model, recompute)
        step = stepper(model, batch, labels, settings.train.lr, device)
        with FlopCounterMode(display=False) as counter:
            step()
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        seconds = median_time(step, args.steps, device)
        rate = counter.get_total_flops() / seconds
        name = "recomputing activations" if recompute else "keeping activations"
        print(
            f"{name:<26}{seconds:>10.3f}{tokens / seconds:>12,.0f}{rate / 1e12:>10.2f}"
            f"{rate / limit:>12.0%} {peak_gib(device):>9.1f}"
        )
    print(f"bf16 matrix products alone: {limit / 1e12:.2f} TFLOP/s")


def write_random(name: str, cfg: StudentConfig, folder: Path) -> None:
    """A model of a released shape with random bf16 weights, and a processor, on disk."""
    shape = SHAPES[name]
    ids = {token: SPECIAL_TOKENS.index(token) for token in SPECIAL_TOKENS}
    config = Qwen3VLConfig(
        text_config={
            "vocab_size": VOCABULARY,
            "num_key_value_heads": 8,
            "head_dim": 128,
            "rope_parameters": {
                "rope_type": "default",
                "rope_theta": 5e6,
                "mrope_section": [24, 20, 20],
                "mrope_interleaved": True,
            },
            "tie_word_embeddings": shape["tied"],
            **shape["text"],
        },
        vision_config={
            "num_heads": 16,
            "out_hidden_size": shape["text"]["hidden_size"],
            "patch_size": 16,
            "num_position_embeddings": 2304,
            **shape["vision"],
        },
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
        tie_word_embeddings=shape["tied"],
    )
    kept = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        with torch.device("cuda" if torch.cuda.is_available() else "cpu"):
            model = Qwen3VLForConditionalGeneration(config)
    finally:
        torch.set_default_dtype(kept)
    model.save_pretrained(folder)
    words = [instruction("reasoning", "cot"), *(answer_line(x) for x in LETTERS), rationale()] * 20
    build_processor(words, 1024, cfg.image_size).save_pretrained(folder)


def rationale() -> str:
    """Text of the greatest length that a rationale may have, 250 words."""
    said = "the blue metal cube near the top moves quickly toward the west and will be very close"
    return " ".join((said.split() * 20)[:250])


def sample(cfg: StudentConfig) -> Sample:
    """A conversation of a prefix, four candidates and a rationale; its frames are noise."""
    pixels = np.random.default_rng(0).integers(
        0, 256, (cfg.frames + 4, cfg.image_size, cfg.image_size, 3), dtype=np.uint8
    )
    parts: list[str | np.ndarray] = [instruction("reasoning", "cot")]
    for letter, candidate in zip(LETTERS, pixels[cfg.frames :], strict=True):
        parts += [f"\nCandidate {letter}: ", candidate]
    clip = Clip(pixels[: cfg.frames], list(range(cfg.frames)))
    return conversation("noise", parts, rationale(), clip)


def switch(model: torch.nn.Module, recompute: bool) -> None:
    """Recompute activations in the backward pass, or keep them."""
    if recompute:
        model.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
        model.enable_input_require_grads()
    else:
        model.gradient_checkpointing_disable()


def stepper(
    model: torch.nn.Module, batch: dict, labels: torch.Tensor, lr: float, device: torch.device
) -> Callable[[], None]:
    """One optimizer step over one sample."""
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=lr)
    model.train()

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16):
            loss = token_mean(model(**batch), labels)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def median_time(step: Callable[[], None], count: int, device: torch.device) -> float:
    """Median seconds of `count` calls, after two that warm up."""
    times = []
    for k in range(count + 2):
        started = time.perf_counter()
        step()
        if device.type == "cuda":
            torch.cuda.synchronize()
        if k >= 2:
            times.append(time.perf_counter() - started)
    return statistics.median(times)


def product_rate(device: torch.device) -> float:
    """FLOP/s of this machine's own bf16 matrix products, the limit that a step is held against."""
    size = 8192 if device.type == "cuda" else 2048
    left = torch.randn(size, size, device=device, dtype=torch.bfloat16)
    return 2 * size**3 / median_time(lambda: left @ left, 5, device)


def peak_gib(device: torch.device) -> float:
    """Peak memory of the device's tensors; on a CPU, of the whole process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name()
    return f"a CPU with {torch.get_num_threads()} threads"


if __name__ == "__main__":
    main()
