"""Choose the candidate that is nearest to an item's query, and score the choice."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from conf.schema import RetrieverConfig
from data.records import LETTERS, SelectionItem
from evaluation.embedders.cache import EmbeddingCache
from evaluation.metrics.ranking import count_ranks, expected_hits, target_scores
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
            from evaluation.retrieval import late_interaction

            scores = late_interaction.pair_scores(query_rows, frame_rows, preset.late.width)
            columns.append(np.concatenate(list(scores)))
        else:
            widest = preset.widths[:1]
            columns += pair_scores(
                GridEmbeddings(query_rows, widest), GridEmbeddings(frame_rows, widest)
            )
    return np.stack(columns, axis=1)


def credit_choices(scores: np.ndarray, answers: Sequence[int]) -> np.ndarray:
    """Return credits (items,): 1 if the target has the highest score, 1/m if it is one of m maxima.

    A target with a NaN score has no credit.
    """
    answers = np.asarray(answers)
    greater, tied = count_ranks(scores, answers)
    return expected_hits(greater, tied, ~np.isnan(target_scores(scores, answers)), 1)


def format_scores(name: str, items: Sequence[SelectionItem], scores: np.ndarray) -> list[str]:
    """Return the scores (items, candidates) of the embedder `name` as one JSON line per item.

    A non-finite score is null.
    """
    rows = [[float(s) if np.isfinite(s) else None for s in row] for row in scores]
    return [
        json.dumps({"by": name, "item_id": item.item_id, "scores": row})
        for item, row in zip(items, rows, strict=True)
    ]


def choose_letters(scores: np.ndarray) -> list[str | None]:
    """Return the letter of each item's highest score; None for a tie or without any score."""
    # fmax ignores NaN, which is no score.
    best = scores == np.fmax.reduce(scores, axis=1, keepdims=True)
    return [LETTERS[row.argmax()] if row.sum() == 1 else None for row in best]
