"""Short trainings of one retriever by `train.contrastive`'s trainer and by plain
sentence-transformers, on the same batches, and what they took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datasets import Dataset
from sentence_transformers import SentenceTransformer, SentenceTransformerTrainer
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
from data.store import Store
from models import memory
from models.lora_kernels import fuse, unfuse
from models.precision import resolve_precision
from models.retriever import embedder
from train.retriever.batches import Batch, QueryBatchSampler, batch_of
from train.retriever.inputs import RetrieverInputs
from train.retriever.loss import RankingLoss
from train.retriever.mining import HardNegatives
from train.retriever.run import (
    IndexCollator,
    RetrieverTrainer,
    build_loss,
    named,
    training_arguments,
)


@dataclass(frozen=True)
class Figures:
    """Seconds of each step after the first, with the making of its samples; losses; the most memory
    (GiB) that the card's tensors, or on a CPU the process, held meanwhile; and the batches."""

    seconds: list[float]
    losses: list[float]
    peak: float
    batches: list[Batch]


def train(
    cfg: ContrastiveCommand, steps: int, plain: bool, helped: bool, one_clip: bool, folder: Path
) -> Figures:
    """Train `steps` steps of the settings' own benchmark and retriever in `folder`. Without
    `helped` it attends as transformers has it, and big blocks of memory are given back each time;
    with `one_clip` all queries of a scene are asked after the clip of its first."""
    if helped:
        memory.keep_freed_memory()
    set_seed(SEED)
    cfg.train.precision = resolve_precision(cfg.train.precision)
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    queries = store.retrieval("train")
    if one_clip:
        queries = after_one_clip(queries)
    model = embedder.load_retriever(
        cfg.retriever, cfg.train.precision, embedder.tokenizer_texts(queries, cfg.retriever), folder
    )
    if not helped:
        model[0].model.set_attn_implementation("sdpa")
    frames = FrameReader(store, cfg.retriever.image_size)
    return trained(cfg, model, queries, frames, store, steps, plain, folder)


def after_one_clip(queries: Sequence[RetrievalQuery]) -> list[RetrievalQuery]:
    first: dict[str, RetrievalQuery] = {}
    for query in queries:
        first.setdefault(query.scene_id, query)
    clips = [first[query.scene_id] for query in queries]
    return [
        replace(query, prefix_start=clip.prefix_start, prefix_stop=clip.prefix_stop)
        for query, clip in zip(queries, clips, strict=True)
    ]


def trained(
    cfg: ContrastiveCommand,
    model: SentenceTransformer,
    queries: Sequence[RetrievalQuery],
    frames: Any,
    store: Store | None,
    steps: int,
    plain: bool,
    folder: Path,
) -> Figures:
    """Train `steps` steps of a model and queries. `frames` are `data.render.frame_cache.FrameReader`,
    or what gives
    pixels like them; `store` is asked for a scene's oracle where the objective needs it."""
    cfg = replace(cfg, train=replace(cfg.train, max_steps=steps))
    order = QueryBatchSampler(
        queries,
        cfg.train.hard_negatives,
        cfg.train.batch,
        cfg.train.batches,
        cfg.train.scene_queries,
        SEED,
    )
    clock = Clock(model.device)
    trainer = (plains if plain else ours)(cfg, model, queries, frames, store, folder, order)
    trainer.add_callback(clock)
    for callback in (ProgressCallback, PrinterCallback):
        trainer.remove_callback(callback)
    trainer.train()
    shown = [
        batch_of([queries[k] for k in places], cfg.train.hard_negatives, True, True)
        for places, _ in zip(order, range(steps), strict=False)
    ]
    return Figures(clock.seconds(), clock.losses, clock.peak, shown)


NEVER = {"eval_strategy": "no", "eval_on_start": False, "save_strategy": "no"}


def ours(cfg, model, queries, frames, store, folder, order) -> Trainer:
    """The trainer as `train.contrastive` makes it, without evaluations and checkpoints."""
    fuse(model)
    inputs = RetrieverInputs(model, frames, cfg.retriever, cfg.train.precision)
    negatives = HardNegatives(queries, cfg.train, model, inputs, RankingLoss, store, folder)
    return RetrieverTrainer(
        model=model,
        args=settings(cfg, folder),
        train_dataset=Dataset.from_list([{"query": k} for k in range(len(queries))]),
        loss=build_loss(cfg, model, inputs, store),
        data_collator=IndexCollator(preprocess_fn=model.preprocess),
        batch_of=lambda places: named(cfg.train, queries, negatives, places),
        sampler=order,
    )


def plains(cfg, model, queries, frames, store, folder, order) -> Trainer:
    """The library's trainer, collator and losses; its user reads pixels as a batch is made."""
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
        mini_batch_num_tokens=cfg.train.mini_batch_tokens,
    )
    return PlainTrainer(
        model=model,
        args=settings(cfg, folder),
        train_dataset=Dataset.from_list([{"query": k} for k in range(len(queries))]),
        loss=MatryoshkaLoss(model, ranking, list(cfg.retriever.widths), cfg.train.width_weights),
        data_collator=collator,
        sampler=order,
    )


def settings(cfg: ContrastiveCommand, folder: Path) -> Any:
    made = training_arguments(cfg, Run("benchmark", folder), None, cfg.train.batch)
    for name, value in {**NEVER, "disable_tqdm": True}.items():
        setattr(made, name, value)
    return made


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
        return super().__call__([self._loaded(self._queries[row["query"]]) for row in rows])

    def _loaded(self, query: RetrievalQuery) -> dict[str, Any]:
        shown = [query.target, *query.hard_negatives]
        asked = embedder.query_input(query, self._frames, self._cfg.retriever)
        pictures = (embedder.frame_input(frame, self._frames) for frame in shown)
        return {"query": asked, **dict(zip(self._columns[1:], pictures, strict=False))}


def repeated(batches: Sequence[Batch]) -> dict[str, float]:
    """The shares of named frames and prefixes that their batch names again."""
    frames = sum(batch.columns.numel() for batch in batches)
    queries = sum(len(batch.queries) for batch in batches)
    return {
        "frames": 1 - sum(len(batch.frames) for batch in batches) / frames,
        "prefixes": 1 - sum(len(batch.prefixes) for batch in batches) / queries,
    }
