"""Mines hard negatives: the wrong frames that the retriever itself ranks highest."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from sentence_transformers.util import semantic_search
from torch.nn.utils.rnn import pad_sequence
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
from models.retriever.embedder import Item, Retriever
from train.retriever.batches import documents_of

HardNegatives = dict[str, list[FrameRef]]
"""Hard negatives by query id."""
CHUNK = 4096
"""Frames that are scored at once."""
SPARE = 64
"""Further frames that are ranked: those near the target are not negatives."""


class HardNegativeMiner(TrainerCallback):
    """Every `train.mine_every` steps, replaces the hard negatives by the frames of the pool that
    the retriever ranks highest, except the target and frames that the scene's oracle displaces by
    less than `train.mine_margin` px from it. The pool is every target and hard negative of the
    training queries.

    Each mining is a file in the run's folder, from which a resumed run continues.

    Args:
        queries: The training queries.
        train: The run's settings.
        model: The retriever that is trained.
        embed: Embeds queries, or frames: their fp32 rows on the CPU.
        store: The benchmark, with its oracle.
        folder: The run's folder.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        train: ContrastiveTrainConfig,
        model: Retriever,
        embed: Callable[[Sequence[Item], str], list[torch.Tensor]],
        store: Store,
        folder: Path,
    ) -> None:
        self._queries, self._train, self._model = queries, train, model
        self._embed, self._store, self._folder = embed, store, folder
        self._mined: HardNegatives = {}

    def update(self, query: RetrievalQuery) -> RetrievalQuery:
        """The query with its current hard negatives."""
        mined = self._mined.get(query.query_id)
        return query if mined is None else replace(query, hard_negatives=tuple(mined))

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        every = self._train.mine_every
        if every and (last := state.global_step // every * every):
            self._mined = read_negatives(self._path(last))

    def on_step_end(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        step, every = state.global_step, self._train.mine_every
        if every and step % every == 0 and step < state.max_steps:
            self._mined = from_main(self._mine)
            if rank() == 0:
                path = self._path(step)
                path.parent.mkdir(exist_ok=True)
                rows = {name: list(map(asdict, frames)) for name, frames in self._mined.items()}
                write_text(path, json.dumps(rows))

    def _mine(self) -> HardNegatives:
        count, device = self._train.hard_negatives, self._model.device
        pool = list(dict.fromkeys(f for q in self._queries for f in documents_of(q, count)))
        was_training = self._model.training
        queries, frames = (
            pad_sequence(self._embed(items, f"mining: {label}"), batch_first=True)
            for items, label in ((self._queries, "queries"), (pool, "frames"))
        )
        self._model.train(was_training)
        ranked = semantic_search(
            queries,
            frames,
            corpus_chunk_size=CHUNK,
            top_k=min(count + SPARE, len(pool)),
            score_function=lambda one, two: self._model.similarity(one.to(device), two.to(device)),
        )
        return {
            query.query_id: select_negatives(
                query,
                [pool[hit["corpus_id"]] for hit in hits],
                self._store,
                self._train.mine_margin,
                count,
            )
            for query, hits in zip(self._queries, ranked, strict=True)
        }

    def _path(self, step: int) -> Path:
        return self._folder / "mined" / f"{step}.json"


def select_negatives(
    query: RetrievalQuery, ranked: Sequence[FrameRef], store: Store, margin: float, count: int
) -> list[FrameRef]:
    """The first `count` ranked frames that are not the query's target, a twin of it, or displaced
    by less than `margin` px from it; filled up with the benchmark's hard negatives."""
    target, least = query.target, max(margin, TWIN_DISTANCE)
    distances = frame_displacements(store.scene(target.scene_id))[target.frame]
    far = [
        frame
        for frame in [*ranked, *query.hard_negatives]
        if frame.scene_id != target.scene_id
        or (frame.frame != target.frame and distances[frame.frame] >= least)
    ]
    return [*dict.fromkeys([*far, *query.hard_negatives])][:count]


def read_negatives(path: Path) -> HardNegatives:
    """Read a mining.

    Raises:
        UserError: The file is missing or damaged.
    """
    try:
        rows = json.loads(path.read_text())
        return {name: [FrameRef(**frame) for frame in frames] for name, frames in rows.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}, the hard negatives that the run resumes with, is missing or damaged: restore "
            "it, or delete the run's folder and train again",
            code="damaged-file",
        ) from error
