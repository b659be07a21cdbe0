"""Exact ranks: every frame of a database is scored for every query, at every width, in blocks.

The score is the cosine of the first entries of two embeddings, or for a multi-vector retriever a
sum of cosines, as fp32. It is bit-identical in any block and at any position. Equal frames
therefore tie, and a target never ranks below itself. Sums of floating-point numbers depend on the
order of the additions, which changes with the shape of a block. Here the entries of unit vectors
are rounded to multiples of a step. In these steps, all products and sums are integers below 2^53,
which float64 represents exactly.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dynapix.conf.files import write_json_lines
from dynapix.data.parallel import batched
from dynapix.data.records import RetrievalQuery
from dynapix.evaluation.metrics.ranking import count_above_and_equal, share_above

if TYPE_CHECKING:
    import torch

GRID, LATE_GRID = 2.0**26, 2.0**20
"""Steps of length 1. With the second, sums over up to 8,000 vectors stay below 2^53; it changes a
cosine by about 2^-20."""
BLOCK_ENTRIES, BLOCK_PRODUCTS = 2**21, 2**21
"""Maximum numbers of entries in a block of frames, and of the products of its vectors with query
vectors. Blocks that are larger take longer to allocate than to compute."""


@dataclass(frozen=True)
class Ranks:
    """The numbers of frames that determine the rank of each query's target.

    Attributes:
        widths: Embedding widths, widest first; None for a baseline without embeddings.
        above, tied: (widths, queries) numbers of frames that score above the target, and of other
            frames that score exactly as the target does.
        found: (queries,) False for a miss: a query that could not be ranked.
        frames: Number of frames in the database.
        vectors: Number of vectors in the database; a multi-vector retriever has several per frame.
            0 without embeddings.
        seconds: Time to rank the database for all queries at all widths.
        twin_above: (widths, queries) 1 if the factual twin of a counterfactual query scores above
            the target, 1/2 if they tie; None in the future pool.
    """

    widths: tuple[int | None, ...]
    above: np.ndarray
    tied: np.ndarray
    found: np.ndarray
    frames: int
    vectors: int = 0
    seconds: float = 0.0
    twin_above: np.ndarray | None = None


def write_ranks(
    folder: Path, ranks: Mapping[str, Ranks], queries: Sequence[RetrievalQuery]
) -> None:
    """Write ranks.jsonl. For a retriever and a query, a row has at each width the number of frames
    `above` the target and the number of other frames `tied` with it; if it is counterfactual, also
    `twin_above`."""
    rows = []
    for name, result in ranks.items():
        for k, query in enumerate(queries):
            row = {"by": name, "query_id": query.query_id, "widths": result.widths}
            row["above"] = result.above[:, k].tolist()
            row["tied"] = result.tied[:, k].tolist()
            if result.twin_above is not None:
                row["twin_above"] = result.twin_above[:, k].tolist()
            rows.append(row)
    write_json_lines(folder / "ranks.jsonl", rows)


def exact_ranks(
    queries: np.ndarray,
    targets: np.ndarray,
    database: Iterable[np.ndarray],
    widths: Sequence[int],
    twins: np.ndarray | None = None,
    late: bool = False,
) -> Ranks:
    """Count, for every query and width, the frames that score above its target or tie with it.

    Args:
        queries: (queries, entries) finite fp32 embeddings.
        targets: (queries, entries) embeddings of each query's target, which is in the database.
        database: Parts (frames, entries) in any order; only one of them is in memory at a time.
        widths: Embedding widths, widest first.
        twins: (queries, entries) embeddings of the factual twins of counterfactual queries.
        late: Whether a row holds several vectors of the only width, see `to_grid`.
    """
    began = time.perf_counter()
    asked = [to_grid(queries, width, late) for width in widths]
    target_scores = [pair_scores(queries, targets, width, late) for width in widths]
    counts = np.zeros((2, len(widths), len(queries)), np.int64)
    frames = vectors = 0
    for part in database:
        # The number of vectors per row may differ between parts.
        per_frame = part.shape[1] // widths[0] if late else 1
        per_query = queries.shape[1] // widths[0] if late else 1
        for block in batched(part, max(1, BLOCK_ENTRIES // part.shape[1])):
            frames += len(block)
            vectors += count_vectors(block, widths[0]) if late else len(block)
            step = max(1, BLOCK_PRODUCTS // (len(block) * per_frame * per_query))
            for k, width in enumerate(widths):
                seen = to_grid(block, width, late)
                for start in range(0, len(queries), step):
                    rows = slice(start, start + step)
                    scores = score(asked[k][rows], seen)
                    counts[:, k, rows] += count_above_and_equal(scores, target_scores[k][rows])
    twin_above = None
    if twins is not None:
        twin_scores = [pair_scores(queries, twins, width, late) for width in widths]
        twin_above = share_above(np.array(twin_scores), np.array(target_scores))
    seconds = time.perf_counter() - began
    (above, equal), found = counts, np.ones(len(queries), bool)
    # The target itself is among the frames that score as it does.
    return Ranks(tuple(widths), above, equal - 1, found, frames, vectors, seconds, twin_above)


def pair_scores(
    queries: np.ndarray, frames: np.ndarray, width: int, late: bool = False
) -> np.ndarray:
    """Return the fp32 scores (rows,) of each query and the frame in the same row. They are
    bit-identical to those of `score`."""
    asked, seen = to_grid(queries, width, late), to_grid(frames, width, late)
    pairs = zip(asked[:, None], seen[:, None], strict=True)
    return np.array([score(query, frame)[0, 0] for query, frame in pairs])


def to_grid(rows: np.ndarray, width: int, late: bool = False) -> np.ndarray | torch.Tensor:
    """Return embeddings in float64, in steps of the grid.

    The first `width` entries of a row are scaled to length 1; the result is (rows, width). With
    `late`, a row holds unit vectors one after the other, padded with vectors of zeros; the result
    is a tensor (rows, vectors, width), on the GPU if there is one.
    """
    if late:
        import torch

        device = "cuda" if torch.cuda.is_available() else "cpu"
        vectors = torch.from_numpy(rows).to(device, torch.float64).unflatten(1, (-1, width))
        return (vectors * LATE_GRID).round_()
    rows = np.array(rows[:, :width], np.float64, order="C")
    lengths = np.sqrt(np.square(rows).sum(axis=1, keepdims=True))
    rows *= GRID / np.where(lengths > 0, lengths, 1)
    return np.rint(rows, out=rows)


def score(queries: np.ndarray | torch.Tensor, frames: np.ndarray | torch.Tensor) -> np.ndarray:
    """Return the fp32 scores (queries, frames) of rows of `to_grid`.

    The score of two vectors is their cosine. By Cauchy-Schwarz, the products of the entries of two
    vectors on the grid add up to little more than 2^52. The rounding to the grid changes a cosine
    by about 2^-27, less than fp32 resolves. The score of two rows of vectors is that of late
    interaction: the sum, over the query's vectors, of the maximum cosine between the query's vector
    and any of the frame's vectors.
    """
    if isinstance(queries, np.ndarray):
        return (queries @ frames.T / GRID**2).astype(np.float32)
    # Padding is replaced by copies of a frame's first vector, which change no maximum.
    frames = frames.where(frames.any(dim=-1, keepdim=True), frames[:, :1])
    products = queries.flatten(0, 1) @ frames.flatten(0, 1).T
    best = products.unflatten(1, frames.shape[:2]).amax(dim=-1)
    total = best.unflatten(0, queries.shape[:2]).sum(dim=1)
    return (total / LATE_GRID**2).float().cpu().numpy()


def count_vectors(rows: np.ndarray, width: int) -> int:
    """Count the vectors in rows of a multi-vector retriever, without the padding."""
    return int(rows.reshape(-1, width).any(axis=1).sum())
