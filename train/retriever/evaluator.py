"""Ranks frames of held-out training scenes while a retriever is trained."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import torch
from sentence_transformers.multi_vector_encoder.evaluation import (
    MultiVectorInformationRetrievalEvaluator,
)
from sentence_transformers.sentence_transformer.evaluation import InformationRetrievalEvaluator
from sentence_transformers.util import cos_sim
from sentence_transformers.util.similarity import maxsim

from conf.schema import RetrieverConfig
from data.records import FrameRef, RetrievalQuery
from data.render.frame_cache import FrameReader
from data.store import Store
from data.tracks.retrieval.database import UniqueFrames
from models.retriever.embedder import Item, Retriever, embed

FRAME_STEP = 6
"""Every so many frames of a held-out scene, one enters the database unless it has a twin there."""
RECALLS = (1, 10, 50)


def build_database(queries: Sequence[RetrievalQuery], store: Store) -> list[FrameRef]:
    """A small database: the queries' targets, and every `FRAME_STEP`th frame of their scenes that
    looks different from every other frame of the database; in the order of the scenes."""
    album = UniqueFrames(store.scene)
    for query in queries:
        album.add(query.target)
    for scene_id in sorted({q.scene_id for q in queries}):
        for frame in range(0, store.scene(scene_id).frames, FRAME_STEP):
            album.add(FrameRef(scene_id, frame))
    return sorted(
        album.frames.keys() | {q.target for q in queries}, key=attrgetter("scene_id", "frame")
    )


class LazyRankingEvaluator:
    """Mixin for the library's evaluators: queries and frames are names, and their pixels are loaded
    a mini-batch at a time.

    Returns recall and reciprocal rank at the full width, by the names of `evaluation.retrieve`.
    Frames with equal scores rank by name, as in the library; in `evaluation.retrieve` they share
    their rank.
    """

    score = staticmethod(cos_sim)

    def __init__(
        self,
        queries: Sequence[RetrievalQuery],
        database: Sequence[FrameRef],
        frames: FrameReader,
        cfg: RetrieverConfig,
        batch: int,
    ) -> None:
        self._frames, self._cfg = frames, cfg
        super().__init__(
            queries={q.query_id: q for q in queries},
            corpus={f.name: f for f in database},
            relevant_docs={q.query_id: {q.target.name} for q in queries},
            accuracy_at_k=list(RECALLS),
            precision_recall_at_k=[1],
            mrr_at_k=[len(database)],
            ndcg_at_k=[1],
            map_at_k=[1],
            batch_size=batch,
            write_csv=False,
            score_functions={"score": self.score},
        )
        self.primary_metric = "recall@10"

    def __call__(
        self, model: Retriever, output_path=None, epoch: int = -1, steps: int = -1, **_
    ) -> dict[str, float]:
        scores = self.compute_metrices(model)["score"]
        recalls = {f"recall@{k}": scores["accuracy@k"][k] for k in RECALLS}
        return {**recalls, "mrr": next(iter(scores["mrr@k"].values()))}

    def embed_inputs(self, model: Retriever, sentences: Sequence[Item], *_: Any, **__: Any) -> Any:
        """Embeddings of queries or of frames.

        Raises:
            UserError: An embedding is not finite.
        """
        return self.stack(embed(model, sentences, self._frames, self._cfg, self.batch_size))


class HeldOutEvaluator(LazyRankingEvaluator, InformationRetrievalEvaluator):
    """For a retriever with one vector."""

    stack = staticmethod(torch.stack)


class MultiVectorHeldOutEvaluator(LazyRankingEvaluator, MultiVectorInformationRetrievalEvaluator):
    """For a retriever with many vectors."""

    score = staticmethod(maxsim)
    stack = staticmethod(list)
