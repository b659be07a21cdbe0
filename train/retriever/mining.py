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
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from data.tracks.retrieval.database import TWIN_DISTANCE
from data.world.displacement import frame_displacements
from models.distributed import from_main
from models.retriever.embedder import Item, Retriever

HardNegatives = dict[str, list[FrameRef]]
"""Hard negatives by query id."""
CHUNK = 4096
"""FrameReader that are scored at once."""
SPARE = 64
"""Further frames that are ranked: those near the target are not negatives."""


class HardNegativeMiner(TrainerCallback):
    """Every `every` steps, replaces the hard negatives by the frames of the pool that the retriever
    ranks highest, except the target and frames that the scene's oracle displaces by less than
    `margin` px from it. The pool is every target and hard negative of the training queries.

    Each mining is a file in the run's folder, from which a resumed run continues.

    Args:
        queries: The training queries.
        count: Hard negatives a query.
        every: Steps between minings; 0 keeps the benchmark's hard negatives.
        margin: Least displacement from the target, in px at 336 x 336.
        model: The retriever that is trained.
        embed: Embeds queries, or frames: their fp32 rows on the CPU.
        store: The benchmark, with its oracle.
        folder: The run's folder.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        count: int,
        every: int,
        margin: float,
        model: Retriever,
        embed: Callable[[Sequence[Item], str], list[torch.Tensor]],
        store: Store,
        folder: Path,
    ) -> None:
        self._queries, self._count = queries, count
        self._every, self._margin = every, margin
        self._model, self._embed = model, embed
        self._store, self._folder = store, folder
        self._mined: HardNegatives = {}

    def update(self, query: RetrievalQuery) -> RetrievalQuery:
        """The query with its current hard negatives."""
        mined = self._mined.get(query.query_id)
        return query if mined is None else replace(query, hard_negatives=tuple(mined))

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        if self._every and (last := state.global_step // self._every * self._every):
            self._mined = read_negatives(self._path(last))

    def on_step_end(self, args, state: TrainerState, control: TrainerControl, **_: Any) -> None:
        step = state.global_step
        if self._every and step % self._every == 0 and step < state.max_steps:
            self._mined = from_main(self._mine)
            if rank() == 0:
                write_negatives(self._mined, self._path(step))

    def _mine(self) -> HardNegatives:
        documents = ((q.target, *q.hard_negatives[: self._count]) for q in self._queries)
        pool = list(dict.fromkeys(frame for frames in documents for frame in frames))
        was_training = self._model.training
        queries, frames = (
            pad_sequence(self._embed(items, f"mining: {label}"), batch_first=True)
            for items, label in ((self._queries, "queries"), (pool, "frames"))
        )
        self._model.train(was_training)
        hits = semantic_search(
            queries,
            frames,
            corpus_chunk_size=CHUNK,
            top_k=min(self._count + SPARE, len(pool)),
            score_function=self._scores,
        )
        ranked = [[pool[hit["corpus_id"]] for hit in row] for row in hits]
        return {
            query.query_id: select_negatives(query, row, self._store, self._margin, self._count)
            for query, row in zip(self._queries, ranked, strict=True)
        }

    def _scores(self, queries: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
        device = self._model.device
        return self._model.similarity(queries.to(device), frames.to(device))

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


def write_negatives(mined: HardNegatives, path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    rows = {name: [asdict(frame) for frame in frames] for name, frames in mined.items()}
    write_text(path, json.dumps(rows))


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
