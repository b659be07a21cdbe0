"""Which of an item's candidates is nearest to its query, and what that choice is worth."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from conf.schema import RetrieverConfig
from data.records import LETTERS, SelectionItem
from evaluation.embedders.cache import EmbeddingCache
from evaluation.metrics.ranking import count_ranks, expected_hits, target_scores
from evaluation.retrieval.exact_search import Cut, pair_scores


def candidate_scores(
    items: Sequence[SelectionItem],
    asked: EmbeddingCache,
    shown: EmbeddingCache,
    preset: RetrieverConfig,
) -> np.ndarray:
    """(items, candidates) fp32 scores at the widest width, the ones that retrieval ranks by: equal
    embeddings tie to the last bit."""
    queries = asked.rows([item.name for item in items])
    per_item = len(items[0].candidates)
    columns = []
    for k in range(per_item):
        frames = shown.rows([item.candidates[k].name for item in items])
        if preset.late is not None:
            from evaluation.retrieval import late_interaction

            found = late_interaction.pair_scores(queries, frames, preset.late.width)
            columns.append(np.concatenate(list(found)))
        else:
            widest = preset.widths[:1]
            (found,) = pair_scores(Cut(queries, widest), Cut(frames, widest))
            columns.append(found)
    return np.stack(columns, axis=1)


def credits(scores: np.ndarray, answers: Sequence[int]) -> np.ndarray:
    """(items,) 1 where the right candidate scores highest, 1/m where it is one of m that do, else
    0, as where its score is NaN."""
    answers = np.asarray(answers)
    greater, tied = count_ranks(scores, answers)
    return expected_hits(greater, tied, ~np.isnan(target_scores(scores, answers)), 1)


def told(name: str, items: Sequence[SelectionItem], scores: np.ndarray) -> list[str]:
    """The scores (items, candidates) that the embedder called `name` gave, a JSON line an item; no
    score is null."""
    return [
        json.dumps({"by": name, "item_id": item.item_id, "scores": [_number(s) for s in row]})
        for item, row in zip(items, scores, strict=True)
    ]


def _number(score: np.float32) -> float | None:
    return float(score) if np.isfinite(score) else None


def letters(scores: np.ndarray) -> list[str | None]:
    """The letter of the candidate that scores highest, an item each; None where several do or none
    has a score."""
    # fmax passes over NaN, which is no score.
    best = scores == np.fmax.reduce(scores, axis=1, keepdims=True)
    return [LETTERS[row.argmax()] if row.sum() == 1 else None for row in best]
