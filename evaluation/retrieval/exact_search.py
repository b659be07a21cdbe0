"""Exact ranks: every frame of a database is scored for every query, at every width, in blocks.

A score is the fp32 number nearest to the cosine of two embeddings' first entries. It is
bit-identical in any block and position, so that equal frames tie and a target never loses to
itself. Plain floating-point sums would depend on the order of the additions, which changes with the
shape of a block; here no sum is rounded at all (see `GridEmbeddings`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from data.parallel import batched
from evaluation.metrics.ranking import count_above_and_equal

GRID = 2.0**26
"""Steps of a unit vector's entries."""
QUERIES, FRAMES = 256, 1024
"""Size of a block: its scores stay in a core's cache while they are counted."""


@dataclass(frozen=True)
class Ranks:
    """The frames that rank before each query's target.

    Attributes:
        widths: Widest first.
        greater, tied: (widths, queries) frames that score above the target, and other frames that
            score exactly as it does.
        found: (queries,) False for a query that cannot be ranked: a miss.
        frames: Size of the database.
        vectors: Vectors that were searched; a multi-vector retriever has several per frame.
        seconds: Time to rank for all queries, at all widths together.
    """

    widths: tuple[int, ...]
    greater: np.ndarray
    tied: np.ndarray
    found: np.ndarray
    frames: int
    vectors: int
    seconds: float

    @classmethod
    def from_counts(
        cls, widths: Sequence[int], counts: np.ndarray, frames: int, vectors: int, began: float
    ) -> Ranks:
        """Build the ranks from the counts (2, widths, queries) of the frames above each target, and
        of those with its score, which include the target."""
        (greater, equal), found = counts, np.ones(counts.shape[2], bool)
        seconds = time.perf_counter() - began
        return cls(tuple(widths), greater, equal - 1, found, frames, vectors, seconds)


class GridEmbeddings:
    """Embeddings split at their widths, each piece a unit vector rounded to an integer grid.

    The integers count steps of 1/`GRID`. By Cauchy-Schwarz, the products of two such pieces add up
    to little more than 2^52 in any order, and float64 holds every integer up to 2^53: a dot product
    of pieces is exact. The grid changes a cosine by about 2^-27, less than fp32 resolves.

    Attributes:
        pieces: (rows, entries) float64 of each piece, narrowest first.
        lengths: (pieces, rows) length of each piece, divided by `GRID`.
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
    """Sum each row in place (rows,), by adding halves.

    Each row's sum is then the same whatever the other rows are.
    """
    while (width := values.shape[1]) > 1:
        half = (width + 1) // 2
        values[:, : width - half] += values[:, half:]
        values = values[:, :half]
    return values[:, 0]


def block_scores(queries: GridEmbeddings, frames: GridEmbeddings) -> Iterator[np.ndarray]:
    """Yield the fp32 scores (queries, frames) of all pairs at each width, narrowest first."""
    products = (a @ b.T for a, b in zip(queries.pieces, frames.pieces, strict=True))
    return _cosines(products, queries.lengths[..., None], queries.norms[..., None], frames)


def pair_scores(queries: GridEmbeddings, frames: GridEmbeddings) -> Iterator[np.ndarray]:
    """Yield the fp32 scores (rows,) of each query and the frame in the same row, narrowest first.

    They are bit-identical to those of `block_scores`.
    """
    products = (
        np.einsum("ij,ij->i", a, b) for a, b in zip(queries.pieces, frames.pieces, strict=True)
    )
    return _cosines(products, queries.lengths, queries.norms, frames)


def _cosines(
    products: Iterable[np.ndarray], lengths: np.ndarray, norms: np.ndarray, frames: GridEmbeddings
) -> Iterator[np.ndarray]:
    """Combine the exact products of pieces into each score separately, in one fixed order."""
    total = None
    for k, product in enumerate(products):
        product *= lengths[k]
        product *= frames.lengths[k]
        total = product if total is None else np.add(total, product, out=total)
        yield (total / (norms[k] * frames.norms[k])).astype(np.float32)


def exact_ranks(
    queries: np.ndarray, targets: np.ndarray, database: Iterable[np.ndarray], widths: Sequence[int]
) -> Ranks:
    """Count, for every query and width, the frames above its target and those that tie with it.

    Args:
        queries: (queries, entries) finite fp32 embeddings.
        targets: (queries, entries) embeddings of each query's target, which is in the database.
        database: Parts (frames, entries) of any size and order, of which one is in memory.
        widths: Widest first.
    """
    began = time.perf_counter()
    grid = GridEmbeddings(queries, widths)
    targets_of = list(pair_scores(grid, GridEmbeddings(targets, widths)))
    counts = np.zeros((2, len(widths), len(queries)), np.int64)
    frames = 0
    blocks = (rows for part in database for rows in batched(part, FRAMES))
    for block in (GridEmbeddings(rows, widths) for rows in blocks):
        frames += len(block)
        for start in range(0, len(queries), QUERIES):
            some = slice(start, start + QUERIES)
            for k, scores in enumerate(block_scores(grid[some], block)):
                counts[:, k, some] += count_above_and_equal(scores, targets_of[k][some])
    return Ranks.from_counts(widths, counts[:, ::-1], frames, frames, began)
