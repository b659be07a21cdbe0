"""Exact ranks: every frame of a database is scored for every query, at every width, in blocks.

The score at a width is the cosine of the first entries of two embeddings, as fp32. It is
bit-identical in any block and at any position. Equal frames therefore tie, and a target never ranks
below itself. Sums of floating-point numbers depend on the order of the additions, which changes
with the shape of a block. Here the sums over entries are exact (see `GridEmbeddings`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from dynapix.conf.files import write_json_lines
from dynapix.data.parallel import batched
from dynapix.data.records import RetrievalQuery
from dynapix.evaluation.metrics.ranking import count_above_and_equal, share_above

GRID = 2.0**26
"""Entries of unit vectors are rounded to multiples of 1 / GRID."""
BLOCK_QUERIES, BLOCK_FRAMES = 256, 1024
"""Size of a block, whose scores fit in the cache of a core while they are counted."""


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
        seconds: Time to rank the database for all queries at all widths.
        twin_above: (widths, queries) 1 if the factual twin of a counterfactual query scores above
            the target, 1/2 if they tie; None in the future pool.
    """

    widths: tuple[int | None, ...]
    above: np.ndarray
    tied: np.ndarray
    found: np.ndarray
    frames: int
    vectors: int
    seconds: float
    twin_above: np.ndarray | None = None

    @classmethod
    def from_counts(
        cls,
        widths: Sequence[int],
        counts: np.ndarray,
        frames: int,
        vectors: int,
        seconds: float,
        twin_above: np.ndarray | None = None,
    ) -> Ranks:
        """Build ranks without misses from the counts (2, widths, queries) of the frames that score
        above the target and of the frames that score as it does, including the target itself."""
        (above, equal), found = counts, np.ones(counts.shape[2], bool)
        return cls(tuple(widths), above, equal - 1, found, frames, vectors, seconds, twin_above)


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


class GridEmbeddings:
    """Embeddings that are split at the widths into pieces, which are rounded to a grid.

    Each piece is scaled to length 1 and stored as integers that count steps of 1 / `GRID`. By
    Cauchy-Schwarz, the products of the entries of two pieces add up to little more than 2^52 in any
    order. float64 represents every integer up to 2^53, so that the dot product of two pieces is
    exact. The rounding changes a cosine by about 2^-27, less than the resolution of fp32.

    Attributes:
        pieces: For each piece, from the first entries to the last, (rows, entries) in float64.
        lengths: (pieces, rows) length of each piece before it is scaled, divided by `GRID`.
        norms: (pieces, rows) length of all entries up to the piece's end; 1 if they are all zero.
    """

    def __init__(self, embeddings: np.ndarray, widths: Sequence[int]) -> None:
        self.pieces, squares = [], []
        for start, stop in pairwise([0, *sorted(widths)]):
            piece = embeddings[:, start:stop].astype(np.float64)
            square = row_sums(np.square(piece))
            piece *= (GRID / np.sqrt(np.where(square > 0, square, 1)))[:, None]
            self.pieces.append(np.rint(piece, out=piece))
            squares.append(square)
        norms = np.sqrt(np.cumsum(squares, axis=0))
        self.norms = np.where(norms > 0, norms, 1)
        self.lengths = np.sqrt(squares) / GRID

    def __len__(self) -> int:
        return len(self.pieces[0])

    def __getitem__(self, rows: slice | np.ndarray) -> GridEmbeddings:
        part = object.__new__(GridEmbeddings)
        part.pieces = [piece[rows] for piece in self.pieces]
        part.lengths, part.norms = self.lengths[:, rows], self.norms[:, rows]
        return part


def row_sums(values: np.ndarray) -> np.ndarray:
    """Return the sums of the rows (rows,) and overwrite `values`.

    The halves of the rows are added repeatedly, so that a sum does not depend on other rows.
    """
    while (width := values.shape[1]) > 1:
        half = (width + 1) // 2
        values[:, : width - half] += values[:, half:]
        values = values[:, :half]
    return values[:, 0]


def block_scores(queries: GridEmbeddings, frames: GridEmbeddings) -> Iterator[np.ndarray]:
    """Yield the fp32 scores (queries, frames) of all pairs at each width, narrowest width first."""
    products = (a @ b.T for a, b in zip(queries.pieces, frames.pieces, strict=True))
    return _cosines(products, queries.lengths[..., None], queries.norms[..., None], frames)


def pair_scores(queries: GridEmbeddings, frames: GridEmbeddings) -> Iterator[np.ndarray]:
    """Yield the fp32 scores (rows,) of each query and the frame in the same row at each width,
    narrowest width first. They are bit-identical to the scores of `block_scores`."""
    products = (
        np.einsum("ij,ij->i", a, b) for a, b in zip(queries.pieces, frames.pieces, strict=True)
    )
    return _cosines(products, queries.lengths, queries.norms, frames)


def _cosines(
    products: Iterable[np.ndarray], lengths: np.ndarray, norms: np.ndarray, frames: GridEmbeddings
) -> Iterator[np.ndarray]:
    """Add the exact products of the pieces, in the order of the pieces, and divide by the norms."""
    total = None
    for k, product in enumerate(products):
        product *= lengths[k]
        product *= frames.lengths[k]
        total = product if total is None else np.add(total, product, out=total)
        yield (total / (norms[k] * frames.norms[k])).astype(np.float32)


def exact_ranks(
    queries: np.ndarray,
    targets: np.ndarray,
    database: Iterable[np.ndarray],
    widths: Sequence[int],
    twins: np.ndarray | None = None,
) -> Ranks:
    """Count, for every query and width, the frames that score above its target or tie with it.

    Args:
        queries: (queries, entries) finite fp32 embeddings.
        targets: (queries, entries) embeddings of each query's target, which is in the database.
        database: Parts (frames, entries) in any order; only one of them is in memory at a time.
        widths: Embedding widths, widest first; None for a baseline without embeddings.
        twins: (queries, entries) embeddings of the factual twins of counterfactual queries.
    """
    began = time.perf_counter()
    grid = GridEmbeddings(queries, widths)
    target_scores = list(pair_scores(grid, GridEmbeddings(targets, widths)))
    counts = np.zeros((2, len(widths), len(queries)), np.int64)
    frames = 0
    blocks = (rows for part in database for rows in batched(part, BLOCK_FRAMES))
    for block in (GridEmbeddings(rows, widths) for rows in blocks):
        frames += len(block)
        for start in range(0, len(queries), BLOCK_QUERIES):
            rows = slice(start, start + BLOCK_QUERIES)
            for k, scores in enumerate(block_scores(grid[rows], block)):
                counts[:, k, rows] += count_above_and_equal(scores, target_scores[k][rows])
    twin_above = None
    if twins is not None:
        pairs = zip(pair_scores(grid, GridEmbeddings(twins, widths)), target_scores, strict=True)
        twin_above = np.array([share_above(*pair) for pair in pairs])[::-1]
    # The scores begin with the narrowest width, the ranks with the widest.
    seconds = time.perf_counter() - began
    return Ranks.from_counts(widths, counts[:, ::-1], frames, frames, seconds, twin_above)
