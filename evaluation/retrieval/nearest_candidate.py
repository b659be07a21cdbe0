"""Choose the candidate that is nearest to an item's query, and score the choice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conf.schema import RetrieverConfig
from data.records import LETTERS, SelectionItem
from evaluation.embedders.cache import EmbeddingCache
from evaluation.retrieval.exact_search import GridEmbeddings, pair_scores


def score_candidates(
    items: Sequence[SelectionItem],
    queries: EmbeddingCache,
    frames: EmbeddingCache,
    preset: RetrieverConfig,
) -> np.ndarray:
    """Return fp32 scores (items, candidates) at the widest width.

    They are the scores that retrieval ranks by: equal embeddings tie to the last bit.
    """
    query_rows = queries.rows([item.name for item in items])
    columns = []
    for k in range(len(items[0].candidates)):
        frame_rows = frames.rows([item.candidates[k].name for item in items])
        if preset.late is not None:
            from evaluation.retrieval.late_interaction import pair_scores as late_scores

            columns.append(late_scores(query_rows, frame_rows, preset.late.width))
        else:
            rows = (GridEmbeddings(of, preset.widths[:1]) for of in (query_rows, frame_rows))
            columns += pair_scores(*rows)
    return np.stack(columns, axis=1)


def credit_choices(scores: np.ndarray, answers: Sequence[int]) -> np.ndarray:
    """Return credits (items,): 1 for a target with the highest score, 1/m for one of m maxima."""
    best = is_best(scores)
    return best[np.arange(len(best)), answers] / best.sum(axis=1)


def choose_letters(scores: np.ndarray) -> list[str | None]:
    """Return the letter of each item's highest score; None for a tie."""
    return [LETTERS[row.argmax()] if row.sum() == 1 else None for row in is_best(scores)]


def is_best(scores: np.ndarray) -> np.ndarray:
    """Return which candidates (items, candidates) have their item's highest score."""
    return scores == scores.max(axis=1, keepdims=True)


def score_rows(name: str, items: Sequence[SelectionItem], scores: np.ndarray) -> list[dict]:
    """Return the rows of scores.jsonl for the scores (items, candidates) of the embedder `name`."""
    return [
        {"by": name, "item_id": item.item_id, "scores": row}
        for item, row in zip(items, scores.tolist(), strict=True)
    ]
