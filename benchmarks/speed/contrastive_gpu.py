"""The retriever's trainer beside plain sentence-transformers at the released sizes, with each
switch on and off: queries a second and peak memory, in one run.

    python -m benchmarks.speed.contrastive_gpu qwen3_vl_8b --base nf4
    python -m benchmarks.speed.contrastive_gpu tiny     # the same in small, on any machine

Weights are random, of the released model's shape, and made on the card, so nothing is fetched;
everything else is the preset's. Frames are noise. Batches are as builders make them: of each scene
four queries, of which two share a prefix and every two a hard negative. The rate of the trainer as
it comes is kept for benchmarks.speed.hours, where a card measured it.
"""

from __future__ import annotations

import argparse
import gc
import logging
import statistics
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.speed import hours
from benchmarks.speed.contrastive_runs import trained
from benchmarks.speed.sft_gpu import CONFIGS, random_model
from benchmarks.speed.sft_runs import SEED, device_name
from conf.compose import compose
from conf.schema import ArchitectureConfig, ContrastiveCommand
from data.records import FPS, FRAMES, FrameRef, RetrievalQuery
from models import compat, parameter_counts
from models.retriever import embedder

VARIANTS: dict[str, dict[str, Any]] = {
    "plain sentence-transformers": {"plain": True},
    "plain, by tokens": {"plain": True, "plain_tokens": 16384},
    "ours": {},
    "  with reused vision features": {"reuse_features": True},
    "  with inputs loaded ahead": {"workers": 2},
    "ours, with both": {"reuse_features": True, "workers": 2},
}
PRESET = "ours"
"""The variant whose rate benchmarks.speed.hours uses."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("retriever", choices=list(CONFIGS))
    parser.add_argument("--base", choices=["nf4", "bf16"], default="nf4")
    parser.add_argument("--batch", type=int, default=64, help="queries a step")
    parser.add_argument("--steps", type=int, default=2, help="timed steps a line, after one")
    args = parser.parse_args()
    warnings.simplefilter("ignore", FutureWarning)
    logging.disable(logging.WARNING)
    if torch.cuda.device_count() > 1:
        parser.error("one card is measured: set CUDA_VISIBLE_DEVICES=0")
    compat.keep_freed_memory()
    measure(args.retriever, args.base, args.batch, args.steps)


def measure(name: str, base: str, batch: int, steps: int) -> None:
    cfg = settings(name, base, batch)
    queries = asked(batch * (steps + 1))
    noise = Noise(cfg.retriever.image_size)
    with tempfile.TemporaryDirectory() as folder:
        model = built(name, cfg, queries, Path(folder))
    recomputed = "recomputed" if cfg.train.gradient_checkpointing else "kept"
    print(f"activations {recomputed}, mini-batches of {cfg.train.mini_batch}")
    print(f"{name} over {base} on {device_name()}, batches of {batch} queries")
    print(parameter_counts.format_towers(parameter_counts.count_towers(model)))
    print(f"{'':<40}{'queries/s':>11}{'peak GiB':>10}{'loss':>10}", flush=True)
    kept = {n: p.detach().clone() for n, p in model.named_parameters() if p.requires_grad}
    for line, switches in VARIANTS.items():
        options = dict(switches)
        plain, tokens = options.pop("plain", False), options.pop("plain_tokens", None)
        variant = replace(cfg, train=replace(cfg.train, **options))
        for parameter_name, parameter in model.named_parameters():
            if parameter_name in kept:
                parameter.data = kept[parameter_name].clone()
        gc.collect()
        try:
            with tempfile.TemporaryDirectory() as folder:
                figures = trained(
                    variant, model, queries, noise, steps + 1, plain, Path(folder), tokens
                )
        except torch.OutOfMemoryError:
            print(f"{line:<40}out of memory", flush=True)
            continue
        rate = batch / statistics.median(figures.seconds)
        print(
            f"{line:<40}{rate:>11.2f}{figures.peak:>10.2f}{figures.losses[-1]:>10.4f}", flush=True
        )
        if line == PRESET and name != "tiny" and model.device.type == "cuda":
            hours.add("contrastive_gpu", cfg.retriever.name, base, rate, device_name())


def settings(name: str, base: str, batch: int) -> ContrastiveCommand:
    preset = "qwen3_vl_emb_8b" if name == "tiny" else name.replace("vl_", "vl_emb_")
    cfg = compose("train.contrastive", ContrastiveCommand, [f"retriever={preset}"])
    cfg.retriever.quantization = "nf4" if base == "nf4" else "none"
    cfg.train.batch = batch
    if name == "tiny":
        cfg.retriever.image_size, cfg.retriever.widths = 128, [192, 64]
    return cfg


def built(name: str, cfg: ContrastiveCommand, queries: list[RetrievalQuery], folder: Path) -> Any:
    """A retriever of a released shape: a small one as the trainer loads it, with another model."""
    preset = cfg.retriever
    small = replace(preset, model=None, architecture=ArchitectureConfig(), quantization="none")
    small = replace(small, lora=replace(small.lora, rank=0))
    model = embedder.load_retriever(
        small, "bf16", embedder.tokenizer_texts(queries, preset), folder
    )
    device = model.device
    model[0].model = random_model(name, preset.quantization, device).model
    embedder.prepare_for_training(model, preset, "bf16")
    return model.to(device)


def asked(count: int) -> list[RetrievalQuery]:
    """Four queries a scene: a prefix with two questions, and two of their own."""
    queries = []
    for k in range(count):
        scene, turn = f"noise-{k // 4:05}", k % 4
        start = 5 * max(0, turn - 1)
        shown = [FrameRef(scene, 60 + 10 * turn), FrameRef(scene, 110 + turn // 2)]
        queries.append(
            RetrievalQuery(
                query_id=f"{scene}-{turn}", split="train", pool="future", builder=1, anchor="time",
                question=f"Which frame shows the scene after the observation, question {turn}?",
                scene_id=scene, prefix_start=start, prefix_stop=start + 50,
                target=shown[0], hard_negatives=(shown[1],), removed_object=None, standard=False,
            )
        )  # fmt: skip
    return queries


class Noise:
    """Frames of noise, by scene and number, as `data.render.frame_cache.FrameReader` gives them."""

    def __init__(self, size: int) -> None:
        self._size = size

    def scene(self, scene_id: str) -> SimpleNamespace:
        return SimpleNamespace(fps=FPS, frames=FRAMES)

    def image(self, scene: str, frame: int) -> Image.Image:
        return Image.fromarray(self.stack(scene, [frame])[0])

    def stack(self, scene: str, shown: list[int]) -> np.ndarray:
        place, size = int(scene.rpartition("-")[2]), (self._size, self._size, 3)
        rngs = (np.random.default_rng([SEED, place, frame]) for frame in shown)
        return np.stack([rng.integers(0, 256, size, dtype=np.uint8) for rng in rngs])


if __name__ == "__main__":
    main()
