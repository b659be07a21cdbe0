"""Exact ranks of multi-vector retrievers by late interaction.

A row holds an input's vectors one after the other, padded with vectors of zeros. A frame's score is
the sum, over the query's vectors, of its maximum cosine with one of the frame's vectors.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np
import torch

from data.parallel import batched
from evaluation.metrics.ranking import count_above_and_equal
from evaluation.retrieval.exact_search import Ranks

GRID = 2.0**20
"""Steps of a unit vector's entries. In this unit the product of two vectors is an integer of up to
2^40, and the sum over up to 8,000 vectors stays below 2^53: float64 holds it exactly, whatever the
order and block of the additions. The grid changes a cosine by about 2^-20."""
VECTORS, CELLS = 4096, 2**23
"""Maximum frame vectors of a block, and their products with query vectors."""


def late_ranks(
    queries: np.ndarray, targets: np.ndarray, database: Iterable[np.ndarray], width: int
) -> Ranks:
    """Count, for every query, the frames that score above its target, and those that tie with it.

    A frame's fp32 score is bit-identical in any block and position, and in any order of its
    vectors.

    Args:
        queries: (queries, entries) finite rows.
        targets: (queries, entries) rows of each query's target, which is in the database.
        database: Parts (frames, entries) of any size and order, of which one is in memory.
    """
    began = time.perf_counter()
    target_scores = pair_scores(queries, targets, width)
    counts = np.zeros((2, 1, len(queries)), np.int64)
    frames = vectors = 0
    # The number of vectors per frame may differ between parts.
    blocks = (
        rows
        for part in database
        for rows in batched(part, max(1, VECTORS // (part.shape[1] // width)))
    )
    for rows in blocks:
        frames += len(rows)
        vectors += int(rows.reshape(-1, width).any(axis=1).sum())
        frame_vectors = vectors_of(rows, width)
        step = max(1, CELLS // (frame_vectors[..., 0].numel() * (queries.shape[1] // width)))
        for start in range(0, len(queries), step):
            some = slice(start, start + step)
            scores = block_scores(to_grid(queries[some], width), frame_vectors)
            counts[:, 0, some] += count_above_and_equal(scores, target_scores[some])
    return Ranks.from_counts([width], counts, frames, vectors, began)


def pair_scores(queries: np.ndarray, frames: np.ndarray, width: int) -> np.ndarray:
    """Score each query and the frame in the same row, bit-identical to `block_scores`: (rows,)."""
    pairs = zip(queries[:, None], frames[:, None], strict=True)
    return np.array([block_scores(to_grid(q, width), vectors_of(f, width))[0, 0] for q, f in pairs])


def block_scores(queries: torch.Tensor, frames: torch.Tensor) -> np.ndarray:
    """Score (queries, vectors, width) and (frames, vectors, width): fp32 (queries, frames)."""
    products = queries.flatten(0, 1) @ frames.flatten(0, 1).T
    best = products.unflatten(1, frames.shape[:2]).amax(dim=-1)
    total = best.unflatten(0, queries.shape[:2]).sum(dim=1)
    return (total / GRID**2).float().cpu().numpy()


def vectors_of(rows: np.ndarray, width: int) -> torch.Tensor:
    """Return frames (rows, vectors, width) in steps of the grid.

    Padding becomes a copy of the frame's first vector, which changes no maximum.
    """
    vectors = to_grid(rows, width)
    return torch.where(vectors.any(dim=-1, keepdim=True), vectors, vectors[:, :1])


def to_grid(rows: np.ndarray, width: int) -> torch.Tensor:
    """Round rows to steps of the grid: (rows, vectors, width) float64."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    vectors = torch.from_numpy(rows).to(device, torch.float64).unflatten(1, (-1, width))
    return (vectors * GRID).round_()
