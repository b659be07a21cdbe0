"""Similarity of each candidate to an item's prefix and question."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynapix.conf.schema import RetrieverConfig
from dynapix.data.records import SelectionItem
from dynapix.evaluation.embedders.cache import EmbeddingCache
from dynapix.evaluation.retrieval.exact_search import GridEmbeddings, pair_scores


def score_candidates(
    items: Sequence[SelectionItem],
    queries: EmbeddingCache,
    frames: EmbeddingCache,
    preset: RetrieverConfig,
) -> np.ndarray:
    """Return the fp32 scores (items, candidates) at the widest width.

    They are computed as in retrieval: equal embeddings have bit-identical scores.
    """
    query_rows = queries.rows([item.name for item in items])
    columns = []
    for k in range(len(items[0].candidates)):
        frame_rows = frames.rows([item.candidates[k].name for item in items])
        if preset.late is not None:
            from dynapix.evaluation.retrieval.late_interaction import pair_scores as late_scores

            columns.append(late_scores(query_rows, frame_rows, preset.late.width))
        else:
            grids = [GridEmbeddings(r, preset.widths[:1]) for r in (query_rows, frame_rows)]
            columns += pair_scores(*grids)
    return np.stack(columns, axis=1)


def score_rows(name: str, items: Sequence[SelectionItem], scores: np.ndarray) -> list[dict]:
    """Return the rows of scores.jsonl for the scores (items, candidates) of the embedder `name`."""
    return [
        {"by": name, "item_id": item.item_id, "scores": row}
        for item, row in zip(items, scores.tolist(), strict=True)
    ]
