"""Short trainings of one retriever by `train.contrastive`'s trainer and by plain
sentence-transformers on the same batches, with their speed and memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sentence_transformers import (
    SentenceTransformer,
    SentenceTransformerTrainer,
    SentenceTransformerTrainingArguments,
)
from sentence_transformers.sentence_transformer.data_collator import (
    SentenceTransformerDataCollator,
)
from sentence_transformers.sentence_transformer.losses import (
    CachedMultipleNegativesRankingLoss,
    MatryoshkaLoss,
)
from transformers import PrinterCallback, ProgressCallback, Trainer, set_seed

from benchmarks.speed.sft_runs import SEED, Clock
from conf.entry import Run
from conf.schema import ContrastiveCommand
from data.build import ensure_benchmark
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from models import compat
from models.lora_kernels import fuse, unfuse
from models.precision import resolve_precision
from models.retriever import embedder
from train.common.arguments import common_arguments
from train.retriever.batches import QueryBatchSampler, batch_columns
from train.retriever.run import build_loss
from train.retriever.trainer import NUMBER, IndexCollator, RetrieverTrainer, numbered_rows


@dataclass(frozen=True)
class Figures:
    """Measurements of a training.

    Attributes:
        seconds: Of each step after the first, with the loading of its samples.
        losses: Of each step.
        peak: GiB of tensors on the GPU, or of the process on a CPU.
    """

    seconds: list[float]
    losses: list[float]
    peak: float


def train(
    cfg: ContrastiveCommand,
    steps: int,
    plain: bool,
    helped: bool,
    plain_tokens: int | None,
    folder: Path,
) -> Figures:
    """Train the settings' retriever on their benchmark for some steps in `folder`. Without
    `helped`, attention is transformers' default, and freed memory returns to the system."""
    if helped:
        compat.keep_freed_memory()
    set_seed(SEED)
    cfg.train.precision = resolve_precision(cfg.train.precision)
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    queries = store.retrieval("train")
    texts = embedder.tokenizer_texts(queries, cfg.retriever)
    model = embedder.load_retriever(cfg.retriever, cfg.train.precision, texts, folder)
    if not helped:
        model[0].model.set_attn_implementation("sdpa")
    frames = FrameReader(store, cfg.retriever.image_size)
    return trained(cfg, model, queries, frames, steps, plain, folder, plain_tokens)


def trained(
    cfg: ContrastiveCommand,
    model: SentenceTransformer,
    queries: Sequence[RetrievalQuery],
    frames: Any,
    steps: int,
    plain: bool,
    folder: Path,
    plain_tokens: int | None = None,
) -> Figures:
    """Train a loaded model for some steps.

    Args:
        frames: A `data.render.frame_cache.FrameReader`, or an object with its methods.
        plain: Whether the library trains by its own means.
        plain_tokens: Tokens in a mini-batch of the library's loss, instead of `train.mini_batch`.
    """
    cfg = replace(cfg, train=replace(cfg.train, max_steps=steps))
    order = QueryBatchSampler(queries, cfg.train.hard_negatives, cfg.train.batch, SEED)
    clock = Clock(model.device)
    if plain:
        trainer = plain_trainer(cfg, model, queries, frames, folder, order, plain_tokens)
    else:
        trainer = own_trainer(cfg, model, queries, frames, folder, order)
    trainer.add_callback(clock)
    for callback in (ProgressCallback, PrinterCallback):
        trainer.remove_callback(callback)
    trainer.train()
    return Figures(clock.seconds(), clock.losses, clock.peak)


def own_trainer(cfg, model, queries, frames, folder, order) -> Trainer:
    """The trainer as `train.contrastive` builds it, without evaluations and checkpoints."""
    fuse(model)
    return RetrieverTrainer(
        model=model,
        args=arguments(cfg, folder),
        train_dataset=numbered_rows(len(queries)),
        loss=build_loss(cfg.train, cfg.retriever, model, frames),
        data_collator=IndexCollator(preprocess_fn=model.preprocess),
        sampler=order,
        columns_of=lambda numbers: batch_columns(
            [queries[k] for k in numbers], cfg.train.hard_negatives
        ),
    )


def plain_trainer(cfg, model, queries, frames, folder, order, tokens) -> Trainer:
    """The library's trainer, collator and losses; its collator reads pixels batch by batch."""
    unfuse(model)
    columns = ["query", "target", *(f"negative_{k}" for k in range(cfg.train.hard_negatives))]
    prompts = dict.fromkeys(columns, cfg.retriever.frame_instruction)
    collator = LateFrames(
        preprocess_fn=model.preprocess,
        prompts=prompts | {"query": cfg.retriever.query_instruction},
    )
    collator.reads(queries, columns, frames, cfg)
    ranking = CachedMultipleNegativesRankingLoss(
        model,
        scale=cfg.train.scale,
        mini_batch_size=cfg.train.mini_batch,
        mini_batch_num_tokens=tokens,
    )
    return PlainTrainer(
        model=model,
        args=arguments(cfg, folder),
        train_dataset=numbered_rows(len(queries)),
        loss=MatryoshkaLoss(model, ranking, list(cfg.retriever.widths), cfg.train.width_weights),
        data_collator=collator,
        sampler=order,
    )


def arguments(cfg: ContrastiveCommand, folder: Path) -> SentenceTransformerTrainingArguments:
    shared = common_arguments(cfg.train, Run("benchmark", folder), SEED, None)
    never = {"eval_strategy": "no", "eval_on_start": False, "save_strategy": "no"}
    return SentenceTransformerTrainingArguments(
        **shared | never | {"dataloader_num_workers": 0, "disable_tqdm": True},
        per_device_train_batch_size=cfg.train.batch,
        dataloader_drop_last=True,
    )


class PlainTrainer(SentenceTransformerTrainer):
    """The library's trainer on batches of ours."""

    def __init__(self, *args: Any, sampler: QueryBatchSampler, **settings: Any) -> None:
        self._sampler = sampler
        super().__init__(*args, **settings)

    def get_batch_sampler(self, *_: Any, **__: Any) -> QueryBatchSampler:
        return self._sampler


class LateFrames(SentenceTransformerDataCollator):
    """The library's collator over rows that name queries; pixels are read as a batch is made."""

    def reads(
        self,
        queries: Sequence[RetrievalQuery],
        columns: Sequence[str],
        frames: FrameReader,
        cfg: ContrastiveCommand,
    ) -> None:
        self._queries, self._columns = queries, columns
        self._frames, self._cfg = frames, cfg

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, Any]:
        return super().__call__([self._loaded(self._queries[row[NUMBER]]) for row in rows])

    def _loaded(self, query: RetrievalQuery) -> dict[str, Any]:
        shown = [query.target, *query.hard_negatives]
        asked = embedder.query_input(query, self._frames, self._cfg.retriever)
        pictures = (embedder.frame_input(frame, self._frames) for frame in shown)
        return {"query": asked, **dict(zip(self._columns[1:], pictures, strict=False))}
