"""How a retriever ranks frames of held-out training scenes, measured while it trains."""

from __future__ import annotations

from sentence_transformers.multi_vector_encoder.evaluation import (
    MultiVectorInformationRetrievalEvaluator,
)
from sentence_transformers.sentence_transformer.evaluation import InformationRetrievalEvaluator
from sentence_transformers.util import cos_sim
from sentence_transformers.util.similarity import maxsim

from conf.schema import RetrieverConfig
from data.frames import Frames
from data.records import FRAMES, FrameRef, RetrievalQuery
from train.retriever import Retriever, frame_input, query_input

STEP = 6
"""Every so many frames of a held-out scene one is in the slice's database."""
RECALLS = (1, 10, 50)


class Slice:
    """What an evaluator of the library's needs to rank a slice of queries; recall and reciprocal
    rank at the full width, under the names that the evaluation command uses."""

    score = staticmethod(cos_sim)

    def __init__(
        self, queries: list[RetrievalQuery], frames: Frames, cfg: RetrieverConfig, batch: int
    ) -> None:
        database = {q.target for q in queries}
        database |= {FrameRef(q.scene_id, f) for q in queries for f in range(0, FRAMES, STEP)}
        ordered = sorted(database, key=lambda f: (f.scene_id, f.frame))
        super().__init__(
            queries={q.query_id: query_input(q, frames, cfg) for q in queries},
            corpus={_name(f): frame_input(f, frames) for f in ordered},
            relevant_docs={q.query_id: {_name(q.target)} for q in queries},
            accuracy_at_k=list(RECALLS),
            precision_recall_at_k=[1],
            mrr_at_k=[len(ordered)],
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


class HeldOutRanking(Slice, InformationRetrievalEvaluator):
    """Of a retriever with one vector."""


class LateHeldOutRanking(Slice, MultiVectorInformationRetrievalEvaluator):
    """Of a retriever with many."""

    score = staticmethod(maxsim)


def _name(frame: FrameRef) -> str:
    return f"{frame.scene_id}/{frame.frame}"
