"""Evaluate a retriever during training: it ranks frames of held-out training scenes."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import torch
from sentence_transformers.base.evaluation import BaseEvaluator

from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.items.database import UniqueFrames
from dynapix.data.records import FrameRef, RetrievalQuery
from dynapix.data.store import Store
from dynapix.models.retriever.inputs import Retriever, embed

FRAME_STEP = 6
"""Interval, in frames, between the frames of a scene that are considered for the database."""
RECALLS = (1, 10, 50)
"""The values of k for which recall@k is measured."""


def build_database(queries: Sequence[RetrievalQuery], store: Store) -> list[FrameRef]:
    """Return a small database, sorted by scene and frame: the queries' targets, and those of their
    factual twins and of every `FRAME_STEP`th frame of their scenes and counterfactual scenes that
    look different from all frames in the database."""
    targets = {q.target: None for q in queries}
    unique = UniqueFrames(store.scene)
    for frame in (*targets, *(q.factual_twin for q in queries if q.factual_twin)):
        unique.add(frame)
    for scene_id in sorted(
        {scene_id for q in queries for scene_id in (q.scene_id, q.target.scene_id)}
    ):
        for frame in range(0, store.scene(scene_id).frames, FRAME_STEP):
            unique.add(FrameRef(scene_id, frame))
    return sorted(unique.frames | targets, key=attrgetter("scene_id", "frame"))


class HeldOutEvaluator(BaseEvaluator):
    """Measures recall@k and the mean reciprocal rank of the queries' targets in a database, at the
    full width of the embeddings.

    Frames with equal scores are ranked in the order of the database. In `evaluation.retrieve`, they
    share a rank.

    Args:
        batch: Number of queries or frames per rank whose pixels are in memory at a time.
    """

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        database: Sequence[FrameRef],
        frames: FrameReader,
        cfg: RetrieverConfig,
        batch: int,
    ) -> None:
        super().__init__()
        self.primary_metric = "recall@10"
        self._queries, self._database = queries, database
        self._frames, self._cfg, self._batch = frames, cfg, batch

    def __call__(
        self, model: Retriever, output_path=None, epoch: int = -1, steps: int = -1
    ) -> dict[str, float]:
        query_vectors, frame_vectors = (
            embed(model, items, self._frames, self._cfg, self._batch)
            for items in (self._queries, self._database)
        )
        scores = model.similarity(query_vectors, frame_vectors)
        order = scores.argsort(dim=1, descending=True, stable=True)
        targets = torch.tensor([self._database.index(q.target) for q in self._queries])
        ranks = (1 + (order.cpu() == targets[:, None]).int().argmax(dim=1)).tolist()
        recalls = {f"recall@{k}": sum(rank <= k for rank in ranks) / len(ranks) for k in RECALLS}
        return {**recalls, "mrr": sum(1 / rank for rank in ranks) / len(ranks)}
