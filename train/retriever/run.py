"""A retriever's training, from its base to the weights that are written."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from datasets import Dataset
from sentence_transformers import (
    MultiVectorEncoderTrainer,
    MultiVectorEncoderTrainingArguments,
    SentenceTransformerTrainer,
    SentenceTransformerTrainingArguments,
)
from sentence_transformers.sentence_transformer.data_collator import (
    SentenceTransformerDataCollator,
)
from sentence_transformers.sentence_transformer.losses import MatryoshkaLoss
from transformers import set_seed

from conf.entry import Run
from conf.errors import UserError
from conf.runs import rank
from conf.schema import ContrastiveCommand, ContrastiveTrainConfig
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from data.store import Store
from data.tracks.retrieval.checks import check_training
from models import distributed, memory
from models.lora_kernels import fuse
from models.resolved import data_digest, resolve_run
from models.retriever import embedder
from models.retriever.embedder import ADAPTERS, Retriever
from train.common import checkpoints, journal, training_loop
from train.common.audit import audit_retriever
from train.retriever import mini_batches
from train.retriever.batches import Batch, QueryBatchSampler, batch_of
from train.retriever.evaluator import HeldOutEvaluator, MultiVectorHeldOutEvaluator, slice_database
from train.retriever.inputs import RetrieverInputs
from train.retriever.late_loss import MultiVectorRankingLoss
from train.retriever.loss import RankingLoss
from train.retriever.mining import HardNegatives
from train.retriever.negatives import Weighing
from train.student.dataset import held_out_scenes, shuffled

log = logging.getLogger(__name__)


def train_retriever(
    cfg: ContrastiveCommand, run: Run, store: Store, share: int
) -> dict[str, float]:
    """Train a retriever in its run's folder and give what it measured there. `share` is a rank's
    part of a step's queries."""
    memory.keep_freed_memory()
    # Adapters are drawn before the trainer sets its seed.
    set_seed(cfg.seed)
    training, validation = split(cfg, store)
    data = data_digest(store.identity, (q.query_id for q in (*training, *validation)))
    with distributed.main_first():
        precision, preset = resolve_run(run.folder, cfg.train.precision, cfg.retriever, data)
    cfg = replace(cfg, retriever=preset, train=replace(cfg.train, precision=precision))
    log.info("loading retriever %s, to compute in %s", preset.name, precision)
    frames = FrameReader(store, cfg.retriever.image_size)
    with training_loop.loading(run.folder, "retriever"):
        model = embedder.load_retriever(
            cfg.retriever,
            cfg.train.precision,
            corpus=embedder.tokenizer_texts(store.retrieval("train"), cfg.retriever),
            folder=run.folder / "untrained",
        )
    fuse(model)
    longest = embedder.longest_query(training, model.tokenizer)
    log.info(audit_retriever(model, cfg.retriever, longest, frames))

    late = cfg.retriever.late is not None
    ranking = MultiVectorRankingLoss if late else RankingLoss
    inputs = RetrieverInputs(model, frames, cfg.retriever, cfg.train.precision)
    train = mini_batches.settle(cfg.train, run.folder, model, inputs, ranking, training)
    cfg = replace(cfg, train=train)
    checkpoint = checkpoints.newest_checkpoint(run.folder)
    negatives = HardNegatives(training, cfg.train, model, inputs, ranking, store, run.folder)
    order = QueryBatchSampler(
        training,
        cfg.train.hard_negatives,
        cfg.train.batch,
        cfg.train.batches,
        cfg.train.scene_queries,
        cfg.seed,
        distributed.ranks(),
    )
    trainer = (MultiVectorTrainer if late else RetrieverTrainer)(
        model=model,
        args=training_arguments(cfg, run, checkpoint, share),
        train_dataset=Dataset.from_list([{"query": k} for k in range(len(training))]),
        evaluator=(MultiVectorHeldOutEvaluator if late else HeldOutEvaluator)(
            validation,
            slice_database(validation, store),
            frames,
            cfg.retriever,
            cfg.train.mini_batch,
        ),
        loss=build_loss(cfg, model, inputs, store),
        data_collator=IndexCollator(preprocess_fn=model.preprocess),
        callbacks=[negatives, training_loop.Epochs(order)],
        batch_of=partial(named, cfg.train, training, negatives),
        sampler=order,
    )
    best = training_loop.train_and_log(
        trainer,
        run,
        checkpoint,
        mini_batches.lower(train),
    )
    if rank() == 0:
        model.save_pretrained(str(run.folder / "retriever"), create_model_card=False)
    log.info("the retriever is in %s", run.folder / "retriever")
    return journal.evaluated(run.folder, best)


def split(
    cfg: ContrastiveCommand, store: Store
) -> tuple[list[RetrievalQuery], list[RetrievalQuery]]:
    """The queries trained on, and some of held-out scenes.

    Raises:
        UserError: there are none, or too few for a batch; or what `check_training` raises.
    """
    queries = store.retrieval("train")
    held_out = held_out_scenes(store)
    training = [q for q in queries if q.scene_id not in held_out]
    # Queries stand builder by builder: a shuffled slice measures all of them.
    validation = shuffled([q for q in queries if q.scene_id in held_out], cfg.seed)
    validation = validation[: cfg.train.validation_queries]
    check_training(store, queries, cfg.train.hard_negatives)
    training_loop.check_not_empty(len(training), "training queries")
    training_loop.check_not_empty(len(validation), "queries of held-out training scenes")
    if len(training) < cfg.train.batch:
        raise UserError(
            f"train.batch={cfg.train.batch} is more than the {len(training)} training queries of "
            f"{store.folder}: lower it"
        )
    return training, validation


def build_loss(
    cfg: ContrastiveCommand, model: Retriever, inputs: RetrieverInputs, store: Store
) -> MatryoshkaLoss | MultiVectorRankingLoss:
    train, late = cfg.train, cfg.retriever.late is not None
    # What is mined for one query may be another's target.
    identical = train.mask_identical or train.mine_every > 0
    ranking = (MultiVectorRankingLoss if late else RankingLoss)(
        model,
        inputs,
        Weighing(store, identical, train.mask_near, train.hard_weight),
        scale=train.scale,
        mini_batch=train.mini_batch,
        mini_batch_tokens=train.mini_batch_tokens,
        reuse_features=train.reuse_features,
        ahead=train.workers,
    )
    if late:
        return ranking
    return MatryoshkaLoss(model, ranking, list(cfg.retriever.widths), train.width_weights)


def training_arguments(
    cfg: ContrastiveCommand, run: Run, checkpoint: Path | None, share: int
) -> SentenceTransformerTrainingArguments | MultiVectorEncoderTrainingArguments:
    late = cfg.retriever.late is not None
    shared: dict[str, Any] = training_loop.arguments(cfg.train, run, cfg.seed, checkpoint)
    made = MultiVectorEncoderTrainingArguments if late else SentenceTransformerTrainingArguments
    return made(
        # Batches are names alone; what they stand for is made while the model computes.
        **{**shared, "dataloader_num_workers": 0},
        per_device_train_batch_size=share,
        dataloader_drop_last=True,
    )


def named(
    train: ContrastiveTrainConfig,
    queries: Sequence[RetrievalQuery],
    negatives: HardNegatives,
    places: Sequence[int],
) -> Batch:
    """The batch of the queries at these places, with the hard negatives that are theirs now."""
    asked = [negatives.given(queries[k]) for k in places]
    return batch_of(asked, train.hard_negatives, train.distinct_frames, train.shared_prefixes)


class IndexCollator(SentenceTransformerDataCollator):
    """Leaves a batch the places of its queries: one that is made ahead may come after a mining."""

    def __call__(self, rows: list[dict[str, int]]) -> dict[str, list[int]]:
        return {"places": [row["query"] for row in rows]}


class NamedBatches:
    """What a trainer of the library's needs for batches of places, composed by a sampler of ours
    and named by `batch_of` when they are taken."""

    def __init__(
        self,
        *args: Any,
        sampler: QueryBatchSampler,
        batch_of: Callable[[Sequence[int]], Batch],
        **settings: Any,
    ) -> None:
        self._sampler = sampler
        self._batch_of = batch_of
        super().__init__(*args, **settings)

    def add_model_card_callback(self, *_: Any) -> None:
        """Rows name queries by number: there is no text of theirs that a model card could show, nor
        a bar for looking for it."""

    def get_batch_sampler(self, *_: Any, **__: Any) -> QueryBatchSampler:
        return self._sampler

    def _load_from_checkpoint(self, checkpoint_path: str) -> None:
        """Adapters are read into those that there are: the library would read the base again, not
        quantised, and find that the weights do not fit."""
        folder = Path(checkpoint_path)
        if (folder / ADAPTERS).exists():
            embedder.load_adapters(self.model, folder)
        else:
            super()._load_from_checkpoint(checkpoint_path)

    def _load_best_model(self) -> None:
        """The library would log that it could not, and keep the last weights."""
        self._load_from_checkpoint(self.state.best_model_checkpoint)

    def collect_features(self, inputs: dict[str, list[int]]) -> tuple[list[Batch], None]:
        return [self._batch_of(inputs["places"])], None


class RetrieverTrainer(NamedBatches, SentenceTransformerTrainer):
    """Of a retriever with one vector."""


class MultiVectorTrainer(NamedBatches, MultiVectorEncoderTrainer):
    """Of a retriever with many."""
