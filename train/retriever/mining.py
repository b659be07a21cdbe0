"""Hard negatives from the retriever as it is: the wrong frames that it ranks highest."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from sentence_transformers.util import semantic_search
from torch.nn.utils.rnn import pad_sequence
from tqdm import tqdm
from transformers import TrainerCallback
from transformers.trainer_callback import TrainerControl, TrainerState

from conf.errors import UserError
from conf.runs import rank, write_text
from conf.schema import ContrastiveTrainConfig
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from data.tracks.retrieval.database import TWIN_DISTANCE
from data.world.displacement import frame_displacements
from models.distributed import from_main
from models.nonfinite_guard import check_finite
from models.retriever.embedder import Retriever
from train.retriever.batches import Batch, batch_of
from train.retriever.inputs import RetrieverInputs
from train.retriever.loss import RankingLoss

log = logging.getLogger(__name__)

Mined = dict[str, list[FrameRef]]
"""The hard negatives of queries, by their ids."""
KINDS = {"query": "queries", "document": "frames"}
AT_ONCE = 4096
"""Frames that queries are held against at once."""
SPARE = 64
"""How many more frames than are wanted are looked at: those near the target are no negatives."""


class HardNegatives(TrainerCallback):
    """Which hard negatives the training queries have: the benchmark's, and every `train.mine_every`
    steps those frames of the pool that the retriever ranks highest, without the target and what its
    scene's oracle displaces by less than `train.mine_margin` px (at 336 x 336) from it. The pool is
    what the benchmark's batches show: targets, and `train.hard_negatives` of each query.

    They are in the run's folder, a file a mining, so that a run that goes on has those it had.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        train: ContrastiveTrainConfig,
        model: Retriever,
        inputs: RetrieverInputs,
        ranking: type[RankingLoss],
        store: Store,
        folder: Path,
    ) -> None:
        """`ranking` says how the model embeds and how embeddings are held against each other."""
        self._queries = queries
        self._every, self._margin = train.mine_every, train.mine_margin
        self._count = train.hard_negatives
        self._mini_batch, self._tokens = train.mini_batch, train.mini_batch_tokens
        self._model, self._inputs, self._ranking = model, inputs, ranking
        self._store, self._folder = store, folder
        self._mined: Mined = {}

    def given(self, query: RetrievalQuery) -> RetrievalQuery:
        """A query with the hard negatives that are its own now."""
        mined = self._mined.get(query.query_id)
        return query if mined is None else replace(query, hard_negatives=tuple(mined))

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        if self._every and (last := state.global_step // self._every * self._every):
            self._mined = read(self._path(last))

    def on_step_end(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        step = state.global_step
        if self._every and step % self._every == 0 and step < state.max_steps:
            self._mined = from_main(self._mine)
            if rank() == 0:
                write(self._mined, self._path(step))

    def _mine(self) -> Mined:
        batch = batch_of(self._queries, self._count, distinct=True, shared=True)
        was_training = self._model.training
        self._model.eval()
        asked = self._embedded(batch, "query", len(batch.prefixes))
        shown = self._embedded(batch, "document", len(batch.frames))
        self._model.train(was_training)
        top = min(self._count + SPARE, len(shown))
        found = semantic_search(
            asked, shown, corpus_chunk_size=AT_ONCE, top_k=top, score_function=self._scores
        )
        ranked = [[batch.frames[hit["corpus_id"]] for hit in hits] for hits in found]
        return {
            query.query_id: wrong(query, frames, self._store, self._margin, self._count)
            for query, frames in zip(batch.queries, ranked, strict=True)
        }

    @torch.no_grad()
    def _embedded(self, batch: Batch, task: str, rows: int) -> torch.Tensor:
        """(queries or frames, ...) fp32 embeddings of so many prefixes or frames, on the CPU; what
        has fewer vectors than others is filled up with zeros."""
        query = task == "query"
        make = self._inputs.of_prefixes if query else self._inputs.of_frames
        names = batch.query_names if query else batch.frame_names
        size = self._mini_batch
        if self._tokens is not None:
            # A prefix has the questions of the whole pool here, not of a batch.
            lengths = self._inputs.prefix_lengths if query else self._inputs.frame_lengths
            size = max(1, self._tokens // max(lengths(batch)))
        made: list[torch.Tensor] = []
        starts = range(0, rows, size)
        for start in tqdm(starts, desc=f"mining: {KINDS[task]}", unit="batch", leave=False):
            some = start, min(start + size, rows)
            given = self._inputs.on_device(make(batch, *some))
            embedded = self._ranking.embed(self._model, given, task).float().cpu()
            check_finite(embedded, partial(names, *some))
            made += embedded
        return pad_sequence(made, batch_first=True)

    def _scores(self, queries: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
        device = self._model.device
        return self._ranking.similarity(queries.to(device), frames.to(device))

    def _path(self, step: int) -> Path:
        return self._folder / "mined" / f"{step}.json"


def wrong(
    query: RetrievalQuery, ranked: Sequence[FrameRef], store: Store, margin: float, count: int
) -> list[FrameRef]:
    """The first `count` of the ranked frames that are not the query's target, its twins, or nearer
    to it than `margin`; the benchmark's own where there are not so many."""
    target, least = query.target, max(margin, TWIN_DISTANCE)
    apart = frame_displacements(store.scene(target.scene_id))[target.frame]
    far = [
        frame
        for frame in [*ranked, *query.hard_negatives]
        if frame.scene_id != target.scene_id
        or (frame.frame != target.frame and apart[frame.frame] >= least)
    ]
    return [*dict.fromkeys([*far, *query.hard_negatives])][:count]


def write(mined: Mined, path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    rows = {name: [asdict(frame) for frame in frames] for name, frames in mined.items()}
    write_text(path, json.dumps(rows))


def read(path: Path) -> Mined:
    """
    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        rows = json.loads(path.read_text())
        return {name: [FrameRef(**frame) for frame in frames] for name, frames in rows.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} is missing or damaged, which holds the hard negatives that the run goes on "
            "with: put it back, or delete the run's folder and train again"
        ) from error
