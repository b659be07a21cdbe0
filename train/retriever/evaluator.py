"""How a retriever ranks frames of held-out training scenes, measured while it trains."""

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

from conf.runs import world_size
from conf.schema import RetrieverConfig
from data.records import FrameRef, RetrievalQuery
from data.render.frame_cache import FrameReader
from data.store import Store
from data.tracks.retrieval.database import UniqueFrames
from models.nonfinite_guard import check_finite
from models.retriever.embedder import Retriever, frame_input, query_input
from train.retriever.batches import frame_title, query_title

STEP = 6
"""Every so many frames of a held-out scene one is in the slice's database, but for twins."""
RECALLS = (1, 10, 50)


def slice_database(queries: Sequence[RetrievalQuery], store: Store) -> list[FrameRef]:
    """The targets of the queries and, of their scenes, every few frames that show what no other
    frame of the database shows; in the order of their scenes."""
    album = UniqueFrames(store.scene)
    for query in queries:
        album.add(query.target)
    for scene_id in sorted({q.scene_id for q in queries}):
        for frame in range(0, store.scene(scene_id).frames, STEP):
            album.add(FrameRef(scene_id, frame))
    return sorted(
        album.frames.keys() | {q.target for q in queries}, key=attrgetter("scene_id", "frame")
    )


class Slice:
    """What an evaluator of the library's needs to rank a database for a slice of queries; recall
    and reciprocal rank at the full width, under the names that the evaluation command uses.

    Frames that score alike stand in the order of their names, as the library has it; the command
    shares the places out among them. It holds names: pixels are read a mini-batch a rank at a time,
    which the library deals out.
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
            query_prompt=cfg.query_instruction,
            corpus_prompt=cfg.frame_instruction,
        )
        self.primary_metric = "recall@10"

    def __call__(
        self, model: Retriever, output_path=None, epoch: int = -1, steps: int = -1, **_
    ) -> dict[str, float]:
        scores = self.compute_metrices(model)["score"]
        results = {f"recall@{k}": scores["accuracy@k"][k] for k in RECALLS}
        return {**results, "mrr": next(iter(scores["mrr@k"].values()))}

    def embed_inputs(
        self, model: Retriever, named: list, encode_fn_name: str, **settings: Any
    ) -> Any:
        """The embeddings of queries (`encode_fn_name` is query) or of frames (document).

        Raises:
            UserError: one is no number.
        """
        title = query_title if encode_fn_name == "query" else frame_title
        at_once = self.batch_size * world_size()
        rows: list[torch.Tensor] = []
        for start in range(0, len(named), at_once):
            some = named[start : start + at_once]
            inputs = [self._input(one) for one in some]
            made = super().embed_inputs(model, inputs, encode_fn_name, **settings)
            for one, row in zip(some, made, strict=True):
                check_finite(row[None], lambda one=one: [title(one)])
            rows += made
        return self.joined(rows)

    def _input(self, one: RetrievalQuery | FrameRef) -> Any:
        if isinstance(one, FrameRef):
            return frame_input(one, self._frames)
        return query_input(one, self._frames, self._cfg)


class HeldOutEvaluator(Slice, InformationRetrievalEvaluator):
    """Of a retriever with one vector."""

    joined = staticmethod(torch.stack)


class MultiVectorHeldOutEvaluator(Slice, MultiVectorInformationRetrievalEvaluator):
    """Of a retriever with many."""

    score = staticmethod(maxsim)
    joined = staticmethod(list)
