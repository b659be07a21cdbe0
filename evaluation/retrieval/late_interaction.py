"""Multi-vector retrievers: their vectors as rows of one length, and exact ranks by late
interaction.

A row is an input's vectors, one after the other, filled up with vectors of zeros, which count for
nothing. A frame's score is the sum, over the query's vectors, of the highest cosine that one of the
frame's has with it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from evaluation.embedders.cache import filled_up
from evaluation.metrics.ranking import count_above_and_equal
from evaluation.retrieval.exact_search import FP32, Ranks

if TYPE_CHECKING:
    from sentence_transformers import MultiVectorEncoder

GRID = 2.0**20
"""Steps of a unit vector's entries. In these, products of two vectors are whole numbers of up to
2^40, and the sum over up to 8,000 vectors stays below 2^53: float64 holds it exactly, in whatever
order and block it is added up. The grid moves a cosine by about 2^-20."""
VECTORS, CELLS = 4096, 2**23
"""Of a block: vectors of frames, and products with those of queries, at most."""


TASKS = {"query": "query", "frame": "document"}
"""What the library calls the kinds of things that are embedded."""


def embedded_rows(model: MultiVectorEncoder, inputs: list, prompt: str, kind: str) -> np.ndarray:
    """(inputs, entries) fp32 rows of queries or frames (`kind`)."""
    found = model.encode(
        inputs,
        prompt=prompt,
        task=TASKS[kind],
        batch_size=len(inputs),
        convert_to_numpy=True,
        show_progress_bar=False,
    )
    return filled_up([vectors.astype(np.float32).reshape(1, -1) for vectors in found])


def late_ranks(
    asked: np.ndarray, targets: np.ndarray, database: Iterable[np.ndarray], width: int
) -> Ranks:
    """Count, for every query, the frames that score above and as its target does.

    Scores are fp32, and come out the same to the last bit in whatever block and place a frame
    stands, whatever the order of its vectors.

    Args:
        asked: (queries, entries) rows of queries, finite.
        targets: (queries, entries) those of each query's target, which is in the database.
        database: (some frames, entries) each, in whatever order and numbers; one at a time is held.
    """
    began = time.perf_counter()
    gold = np.concatenate(list(pair_scores(asked, targets, width)))
    counts = np.zeros((2, 1, len(asked)), np.int64)
    frames = vectors = 0
    for rows in blocks(database, width):
        frames += len(rows)
        vectors += int(rows.reshape(-1, width).any(axis=1).sum())
        shown = vectors_of(rows, width)
        at_once = max(1, CELLS // (shown[..., 0].numel() * (asked.shape[1] // width)))
        for start in range(0, len(asked), at_once):
            some = slice(start, start + at_once)
            scores = block_scores(whole(asked[some], width), shown)
            counts[:, 0, some] += count_above_and_equal(scores, gold[some])
    greater, equal = counts
    # The target itself is among those that score as it does.
    found = np.ones(greater.shape, bool)
    size, seconds = vectors * width * FP32, time.perf_counter() - began
    return Ranks((width,), greater, equal - 1, found, frames, (size,), (seconds,))


def pair_scores(asked: np.ndarray, shown: np.ndarray, width: int) -> Iterator[np.ndarray]:
    """Of each query and the frame in the same row: what `block_scores` gives, to the last bit."""
    for query, frame in zip(asked, shown, strict=True):
        yield block_scores(whole(query[None], width), vectors_of(frame[None], width))[0]


def block_scores(asked: torch.Tensor, shown: torch.Tensor) -> np.ndarray:
    """(queries, frames) fp32 scores of (queries, vectors, width) and (frames, vectors, width)."""
    products = asked.flatten(0, 1) @ shown.flatten(0, 1).T
    best = products.unflatten(1, shown.shape[:2]).amax(dim=-1)
    total = best.unflatten(0, asked.shape[:2]).sum(dim=1)
    return (total / GRID**2).float().cpu().numpy()


def blocks(database: Iterable[np.ndarray], width: int) -> Iterator[np.ndarray]:
    for part in database:
        at_once = max(1, VECTORS // (part.shape[1] // width))
        for start in range(0, len(part), at_once):
            yield part[start : start + at_once]


def vectors_of(rows: np.ndarray, width: int) -> torch.Tensor:
    """(rows, vectors, width) of frames in steps of the grid. What fills a row up is the frame's
    first vector once more, which changes no maximum."""
    vectors = whole(rows, width)
    return torch.where(vectors.any(dim=-1, keepdim=True), vectors, vectors[:, :1])


def whole(rows: np.ndarray, width: int) -> torch.Tensor:
    """(rows, vectors, width) float64 in steps of the grid."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    vectors = torch.from_numpy(rows).to(device, torch.float64).unflatten(1, (-1, width))
    return (vectors * GRID).round_()
