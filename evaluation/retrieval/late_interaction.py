"""Exact ranks of multi-vector retrievers by late interaction.

A row holds the vectors of a query or a frame one after the other, padded with vectors of zeros. The
score of a frame is the sum, over the query's vectors, of the maximum cosine between the query's
vector and any of the frame's vectors.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np
import torch

from dynapix.data.parallel import batched
from dynapix.evaluation.metrics.ranking import count_above_and_equal, share_above
from dynapix.evaluation.retrieval.exact_search import Ranks

GRID = 2.0**20
"""Entries of unit vectors are rounded to multiples of 1 / GRID. In these steps, the dot product of
two vectors is an integer of up to 2^40, and the sum over up to 8,000 vectors stays below 2^53.
float64 represents it exactly, in any order and block of the additions. The rounding changes a
cosine by about 2^-20."""
BLOCK_VECTORS, BLOCK_PRODUCTS = 4096, 2**23
"""Maximum numbers of frame vectors in a block, and of their dot products with query vectors."""


def late_ranks(
    queries: np.ndarray,
    targets: np.ndarray,
    database: Iterable[np.ndarray],
    width: int,
    twins: np.ndarray | None = None,
) -> Ranks:
    """Count, for every query, the frames that score above its target or tie with it.

    A frame's fp32 score is bit-identical in any block and at any position, and in any order of its
    vectors.

    Args:
        queries: (queries, entries) finite rows.
        targets: (queries, entries) rows of each query's target, which is in the database.
        database: Parts (frames, entries) in any order; only one of them is in memory at a time.
        width: Number of entries of a vector.
        twins: (queries, entries) rows of the factual twins of counterfactual queries.
    """
    began = time.perf_counter()
    target_scores = pair_scores(queries, targets, width)
    counts = np.zeros((2, 1, len(queries)), np.int64)
    frames = vectors = 0
    # The number of vectors per row may differ between parts.
    blocks = (
        rows
        for part in database
        for rows in batched(part, max(1, BLOCK_VECTORS // (part.shape[1] // width)))
    )
    for rows in blocks:
        frames += len(rows)
        vectors += int(rows.reshape(-1, width).any(axis=1).sum())
        frame_vectors = frames_to_grid(rows, width)
        products = frame_vectors[..., 0].numel() * (queries.shape[1] // width)
        step = max(1, BLOCK_PRODUCTS // products)
        for start in range(0, len(queries), step):
            part = slice(start, start + step)
            scores = block_scores(to_grid(queries[part], width), frame_vectors)
            counts[:, 0, part] += count_above_and_equal(scores, target_scores[part])
    twin_above = None
    if twins is not None:
        twin_above = share_above(pair_scores(queries, twins, width), target_scores)[None]
    seconds = time.perf_counter() - began
    return Ranks.from_counts([width], counts, frames, vectors, seconds, twin_above)


def pair_scores(queries: np.ndarray, frames: np.ndarray, width: int) -> np.ndarray:
    """Return the fp32 scores (rows,) of each query and the frame in the same row. They are
    bit-identical to the scores of `block_scores`."""
    pairs = zip(queries[:, None], frames[:, None], strict=True)
    scores = (block_scores(to_grid(q, width), frames_to_grid(f, width)) for q, f in pairs)
    return np.array([score[0, 0] for score in scores])


def block_scores(queries: torch.Tensor, frames: torch.Tensor) -> np.ndarray:
    """Return fp32 scores (queries, frames) of queries and frames (rows, vectors, width)."""
    products = queries.flatten(0, 1) @ frames.flatten(0, 1).T
    best = products.unflatten(1, frames.shape[:2]).amax(dim=-1)
    total = best.unflatten(0, queries.shape[:2]).sum(dim=1)
    return (total / GRID**2).float().cpu().numpy()


def frames_to_grid(rows: np.ndarray, width: int) -> torch.Tensor:
    """Convert the rows of frames as `to_grid`, and replace padding by copies of a frame's first
    vector, which change no maximum."""
    vectors = to_grid(rows, width)
    return torch.where(vectors.any(dim=-1, keepdim=True), vectors, vectors[:, :1])


def to_grid(rows: np.ndarray, width: int) -> torch.Tensor:
    """Return rows as vectors (rows, vectors, width) in float64, rounded to steps of the grid."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    vectors = torch.from_numpy(rows).to(device, torch.float64).unflatten(1, (-1, width))
    return (vectors * GRID).round_()
