"""Compares the retriever trainer with plain sentence-transformers in speed and memory.

    python -m benchmarks.speed.contrastive                      # a tiny retriever, on any machine
    python -m benchmarks.speed.contrastive --batch 32 128 512   # with several batch sizes
    python -m benchmarks.speed.contrastive qwen3_vl_emb_8b      # a released size, on a GPU

Every variant trains on the same batches of queries, in a process of its own. The script prints
medians over the rounds and the ratios to our trainer with the preset's settings. A released size
has random weights, so that nothing is downloaded.

Plain sentence-transformers uses the library's trainer, collator and losses: by default its cached
loss with mini-batches of 32, which embeds a batch twice. Like our trainer, it reads the pixels of
one batch at a time. The other variants have each setting that could make it faster: the loss that
embeds a batch once, the MALLOC_* environment variables, which have the effect of our trainer's
calls of mallopt, and this project's attention.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sentence_transformers import SentenceTransformerTrainer, SentenceTransformerTrainingArguments
from sentence_transformers.sentence_transformer.data_collator import SentenceTransformerDataCollator
from sentence_transformers.sentence_transformer.losses import (
    CachedMultipleNegativesRankingLoss,
    MatryoshkaLoss,
    MultipleNegativesRankingLoss,
)
from transformers import Trainer, set_seed

from benchmarks.arguments import positive_int
from benchmarks.speed import comparison
from benchmarks.speed.comparison import MALLOC, OURS, SEED, Measurements, timing_arguments
from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.runs import Run
from dynapix.conf.schema import ContrastiveCommand
from dynapix.data.build import ensure_benchmark
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.models import compat
from dynapix.models.layers.attention import choose_attention
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.models.retriever import embedder
from dynapix.models.retriever.inputs import Retriever, frame_input, query_input
from dynapix.train.retriever.batches import QueryBatchSampler
from dynapix.train.retriever.trainer import NUMBER, build_trainer, numbered_rows


@dataclass(frozen=True)
class Variant:
    """A trainer and its settings."""

    overrides: tuple[str, ...] = ()
    """Settings of `train` that differ from the preset."""
    plain: bool = False
    """Train with plain sentence-transformers instead of our trainer."""
    cached: bool = False
    """Use the loss of sentence-transformers that embeds a batch twice, in mini-batches."""
    our_attention: bool = False
    """Give plain sentence-transformers this project's attention."""
    environment: dict[str, str] = field(default_factory=dict)


DEFAULT = "plain, default settings"
CACHED = ("mini_batch=32",)
VARIANTS = {
    OURS: Variant(),
    "ours, mini-batch 16": Variant(("mini_batch=16", "reuse_features=false")),
    "ours, mini-batch 16, features reused": Variant(("mini_batch=16", "reuse_features=true")),
    DEFAULT: Variant(CACHED, plain=True, cached=True),
    "plain, cached, MALLOC_*": Variant(CACHED, plain=True, cached=True, environment=MALLOC),
    "plain, one pass": Variant(plain=True),
    "plain, one pass, MALLOC_*": Variant(plain=True, environment=MALLOC),
    "plain, one pass, MALLOC_*, our attention": Variant(
        plain=True, our_attention=True, environment=MALLOC
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--batch", type=positive_int, nargs="+", help="queries per step, by default the preset's"
    )
    parser.add_argument("--benchmark", default="tiny")
    comparison.add_arguments(parser, steps=3, variants=VARIANTS)
    args = comparison.parse_arguments(parser)
    overrides = [
        f"retriever={args.preset}", f"benchmark={args.benchmark}", f"store={args.store}",
        f"retriever.quantization={args.quantization}",
        f"train.precision={args.precision}",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        if args.preset != "tiny":
            comparison.run_in_process(write_base, overrides, args.preset, Path(folder))
            overrides.append(f"retriever.model={folder}")
        for batch in args.batch or [None]:
            print(f"\nbatches of {batch or 'the preset'}")
            settings = [*overrides, *([f"train.batch={batch}"] if batch else [])]
            comparison.compare(
                lambda name, settings=settings: measure_in_process(
                    settings, VARIANTS[name], args.steps
                ),
                args.only or list(VARIANTS),
                OURS,
                "queries",
                args,
            )


def measure_in_process(overrides: list[str], variant: Variant, steps: int) -> Measurements:
    environment = variant.environment
    return comparison.run_in_process(measure, overrides, variant, steps, environment=environment)


def measure(overrides: list[str], variant: Variant, steps: int) -> Measurements:
    """Train a variant in this process for `steps` steps after the first one."""
    changes = [f"train.{change}" for change in variant.overrides]
    overrides = [*overrides, *changes, f"train.max_steps={steps + 1}"]
    cfg = compose("train.contrastive", ContrastiveCommand, overrides)
    if not variant.plain:
        compat.keep_freed_memory()
    set_seed(SEED)
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    queries = store.retrieval("train")
    frames = FrameReader(store, cfg.retriever.image_size)
    with tempfile.TemporaryDirectory() as folder:
        with keep_plain() if variant.plain else nullcontext():
            model = embedder.load_retriever(cfg.retriever, cfg.train.precision, [], Path(folder))
        if variant.our_attention:
            choose_attention(model[0].model, cfg.train.precision, cfg.retriever.max_length)
        if variant.plain:
            trainer = build_plain_trainer(cfg, model, queries, frames, Path(folder), variant.cached)
        else:
            use_fast_layers(model)
            run, batch = Run("benchmark", Path(folder)), cfg.train.batch
            # Nothing is evaluated, but the trainer requires a held-out query.
            trainer = build_trainer(cfg, run, store, model, queries, queries[:1], batch, None)
        return comparison.train(trainer, cfg.train.batch)


def keep_plain() -> AbstractContextManager[Any]:
    """Let `load_retriever` leave the computation of a model as it is in the libraries."""
    return patch.object(embedder, "choose_computation", lambda *_: None)


def build_plain_trainer(
    cfg: ContrastiveCommand,
    model: Retriever,
    queries: list[RetrievalQuery],
    frames: FrameReader,
    folder: Path,
    cached: bool,
) -> Trainer:
    """Return a trainer with the library's collator and losses."""
    columns = ["query", "target", *(f"negative_{k}" for k in range(cfg.train.hard_negatives))]
    prompts = dict.fromkeys(columns, model.prompts["document"])
    collator = FrameCollator(
        preprocess_fn=model.preprocess,
        prompts=prompts | {"query": model.prompts["query"]},
    )
    collator.load = lambda number: load_columns(queries[number], columns, frames, cfg)
    scale, size = cfg.train.scale, cfg.train.mini_batch
    ranking = (
        CachedMultipleNegativesRankingLoss(model, scale=scale, mini_batch_size=size)
        if cached
        else MultipleNegativesRankingLoss(model, scale=scale)
    )
    sampler = QueryBatchSampler(queries, cfg.train.hard_negatives, cfg.train.batch, SEED)
    return SentenceTransformerTrainer(
        model=model,
        args=SentenceTransformerTrainingArguments(
            **timing_arguments(cfg.train, folder) | {"dataloader_num_workers": 0},
            per_device_train_batch_size=cfg.train.batch,
            dataloader_drop_last=True,
            batch_sampler=lambda *_, **__: sampler,
        ),
        train_dataset=numbered_rows(len(queries)),
        loss=MatryoshkaLoss(model, ranking, list(cfg.retriever.widths)),
        data_collator=collator,
    )


def load_columns(
    query: RetrievalQuery, columns: Sequence[str], frames: FrameReader, cfg: ContrastiveCommand
) -> dict[str, Any]:
    """Return the inputs of a query, its target and its hard negatives, with their pixels."""
    images = (frame_input(f, frames) for f in (query.target, *query.hard_negatives))
    inputs = [query_input(query, frames, cfg.retriever), *images]
    return dict(zip(columns, inputs, strict=False))


class FrameCollator(SentenceTransformerDataCollator):
    """The library's collator for rows with the numbers of queries; `load` reads their inputs."""

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, Any]:
        return super().__call__([self.load(row[NUMBER]) for row in rows])


def write_base(overrides: list[str], preset: str, folder: Path) -> None:
    """Save a base of a preset's size, with random weights and a tokenizer for the benchmark."""
    cfg = compose("train.contrastive", ContrastiveCommand, overrides)
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    texts = embedder.tokenizer_texts(store.retrieval("train"), cfg.retriever)
    size = preset.replace("emb_", "")
    comparison.write_random_base(size, texts, cfg.retriever.image_size, folder)


if __name__ == "__main__":
    with report_failures():
        main()
