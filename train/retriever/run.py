"""The training of a retriever, from its base to the saved weights."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sentence_transformers import (
    MultiVectorEncoderTrainingArguments,
    SentenceTransformerTrainingArguments,
)
from sentence_transformers.sentence_transformer.losses import MatryoshkaLoss
from torch import nn
from transformers import set_seed

from conf.entry import Run
from conf.runs import rank
from conf.schema import ContrastiveCommand, ContrastiveTrainConfig, RetrieverConfig
from data.render.frame_cache import FrameReader
from data.store import Store
from models import compat, distributed
from models.lora_kernels import fuse
from models.resolved import data_digest, resolve_run
from models.retriever.embedder import (
    Retriever,
    embed,
    load_retriever,
    longest_query,
    tokenizer_texts,
)
from train.common import arguments, callbacks, checkpoints, journal, training_loop
from train.common.audit import audit_retriever
from train.retriever.batches import QueryBatchSampler, batch_columns, split_queries
from train.retriever.evaluator import (
    HeldOutEvaluator,
    MultiVectorHeldOutEvaluator,
    build_database,
)
from train.retriever.inputs import RetrieverInputs
from train.retriever.loss import MultiVectorRankingLoss, RankingLoss
from train.retriever.mining import HardNegativeMiner
from train.retriever.trainer import (
    IndexCollator,
    MultiVectorTrainer,
    RetrieverTrainer,
    numbered_rows,
)

log = logging.getLogger(__name__)


def train_retriever(
    cfg: ContrastiveCommand, run: Run, store: Store, rank_batch: int
) -> dict[str, float]:
    """Train a retriever in its run's folder and return its final metrics. `rank_batch` is the
    number of queries that each rank contributes to a step."""
    compat.keep_freed_memory()
    # New adapters are initialised before the trainer sets its seed.
    set_seed(cfg.seed)
    checkpoint = checkpoints.newest_checkpoint(run.folder)
    training, validation = split_queries(
        store, cfg.train.batch, cfg.train.hard_negatives, cfg.train.validation_queries, cfg.seed
    )
    data = data_digest(store.identity, (q.query_id for q in (*training, *validation)))
    with distributed.main_first():
        precision, preset = resolve_run(run.folder, cfg.train.precision, cfg.retriever, data)
    train = replace(cfg.train, precision=precision)

    log.info("loading retriever %s, which computes in %s", preset.name, precision)
    frames = FrameReader(store, preset.image_size)
    texts = tokenizer_texts(store.retrieval("train"), preset)
    with training_loop.explain_load_errors(run.folder, "retriever"):
        model = load_retriever(preset, precision, texts, run.folder / "untrained")
    fuse(model)
    log.info(audit_retriever(model, preset, longest_query(training, model.tokenizer), frames))

    def embed_rows(items: Sequence[Any], label: str) -> list[Any]:
        return embed(model, items, frames, preset, train.mini_batch, label)

    miner = HardNegativeMiner(
        training, train.hard_negatives, train.mine_every, train.mine_margin,
        model, embed_rows, store, run.folder,
    )  # fmt: skip
    world_size = train.batch // rank_batch
    sampler = QueryBatchSampler(training, train.hard_negatives, train.batch, cfg.seed, world_size)
    late = preset.late is not None
    evaluator_class = MultiVectorHeldOutEvaluator if late else HeldOutEvaluator
    arguments_class = (
        MultiVectorEncoderTrainingArguments if late else SentenceTransformerTrainingArguments
    )
    trainer = (MultiVectorTrainer if late else RetrieverTrainer)(
        model=model,
        args=arguments_class(
            **arguments.common_arguments(train, run, cfg.seed, checkpoint)
            # A batch is a list of numbers: the loss loads its pixels.
            | {"dataloader_num_workers": 0},
            per_device_train_batch_size=rank_batch,
            dataloader_drop_last=True,
        ),
        train_dataset=numbered_rows(len(training)),
        evaluator=evaluator_class(
            validation, build_database(validation, store), frames, preset, train.mini_batch
        ),
        loss=build_loss(train, preset, model, frames),
        data_collator=IndexCollator(preprocess_fn=model.preprocess),
        callbacks=[miner, callbacks.EpochCallback(sampler)],
        sampler=sampler,
        columns_of=lambda numbers: batch_columns(
            [miner.update(training[k]) for k in numbers], train.hard_negatives
        ),
    )
    best = training_loop.run_training(trainer, run, checkpoint, memory_advice(train))
    if rank() == 0:
        model.save_pretrained(str(run.folder / "retriever"), create_model_card=False)
    log.info("the retriever is in %s", run.folder / "retriever")
    return journal.run_metrics(run.folder, best)


def build_loss(
    train: ContrastiveTrainConfig, preset: RetrieverConfig, model: Retriever, frames: FrameReader
) -> nn.Module:
    """The ranking loss, over all widths if the retriever has one vector."""
    bf16 = train.precision == "bf16"
    options = {
        "inputs": RetrieverInputs(model, frames, preset, bf16, train.reuse_features),
        "scale": train.scale,
        "mini_batch": train.mini_batch,
        "prefetch": train.workers,
    }
    if preset.late is not None:
        return MultiVectorRankingLoss(model, **options)
    ranking = RankingLoss(model, **options)
    return MatryoshkaLoss(model, ranking, list(preset.widths), train.width_weights)


def memory_advice(train: ContrastiveTrainConfig) -> str:
    """The settings to change when memory runs out."""
    options = [f"lower train.mini_batch={train.mini_batch}, which changes no gradient"]
    if not train.gradient_checkpointing:
        options.append("set train.gradient_checkpointing=true")
    if train.reuse_features:
        options.append("set train.reuse_features=false")
    return f"{', or '.join(options)}, in another run (run=NAME)"
