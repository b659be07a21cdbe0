"""Exact ranks: every frame of a database held against every query, at every width, in blocks.

A score is the fp32 number nearest to the cosine of two embeddings' first entries. It comes out the
same to the last bit in whatever block and place a frame stands, so that equal frames tie, wherever
they are, and a target never loses to itself: floating-point sums depend on the order in which a
library adds, and that changes with the shape of a block. Here no sum is rounded at all (`Cut`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from evaluation.metrics.ranking import count_above_and_equal

GRID = 2.0**26
"""Steps of a unit vector's entries."""
FP32 = np.dtype(np.float32).itemsize
QUERIES, FRAMES = 256, 1024
"""Of a block: its scores stay in a core's cache while they are counted."""


@dataclass(frozen=True)
class Ranks:
    """What stands before each query's target.

    Attributes:
        widths: widest first.
        greater, tied: (widths, queries) frames that score above the target, and other frames that
            score exactly as it does.
        found: (widths, queries) False where the target was not found; an exact search finds it.
        frames: size of the database.
        bytes: at each width, of what stands for the database: its vectors, or an index of them.
        seconds: at each width, to rank for all queries; an exact search ranks at all at once.
    """

    widths: tuple[int, ...]
    greater: np.ndarray
    tied: np.ndarray
    found: np.ndarray
    frames: int
    bytes: tuple[int, ...] | None = None
    seconds: tuple[float, ...] | None = None


class Cut:
    """Embeddings cut where their widths end, each piece a unit vector of whole numbers.

    The numbers count steps of 1/`GRID`. By Cauchy and Schwarz the products of two such pieces add
    up, in whatever order, to little more than 2^52, and float64 holds every whole number to 2^53:
    a dot product of pieces is exact. The grid moves a cosine by about 2^-27, less than fp32 tells.

    Attributes:
        pieces: (rows, entries) float64 of each piece, narrowest first.
        lengths: (pieces, rows) of each piece, divided by `GRID`.
        norms: (pieces, rows) of all entries up to the piece's end; 1 where they are all zero.
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

    def __getitem__(self, rows: slice | np.ndarray) -> Cut:
        part = object.__new__(Cut)
        part.pieces = [piece[rows] for piece in self.pieces]
        part.lengths, part.norms = self.lengths[:, rows], self.norms[:, rows]
        return part


def row_sums(values: np.ndarray) -> np.ndarray:
    """Sums (rows,) of the rows, which are used up: halves are added to halves, so that each row's
    sum is the same whatever rows stand beside it."""
    while (width := values.shape[1]) > 1:
        half = (width + 1) // 2
        values[:, : width - half] += values[:, half:]
        values = values[:, :half]
    return values[:, 0]


def block_scores(asked: Cut, shown: Cut) -> Iterator[np.ndarray]:
    """The fp32 scores (queries, frames) of every query and frame at each width, narrowest first."""
    products = (a @ b.T for a, b in zip(asked.pieces, shown.pieces, strict=True))
    return _cosines(products, asked.lengths[..., None], asked.norms[..., None], shown)


def pair_scores(asked: Cut, shown: Cut) -> Iterator[np.ndarray]:
    """The fp32 scores (rows,) of each query and the frame in the same row, narrowest first: those
    that `block_scores` gives, to the last bit."""
    products = (
        np.einsum("ij,ij->i", a, b) for a, b in zip(asked.pieces, shown.pieces, strict=True)
    )
    return _cosines(products, asked.lengths, asked.norms, shown)


def _cosines(
    products: Iterable[np.ndarray], lengths: np.ndarray, norms: np.ndarray, shown: Cut
) -> Iterator[np.ndarray]:
    """From the exact products of pieces on, each score is made by itself, in one fixed order."""
    total = None
    for k, product in enumerate(products):
        product *= lengths[k]
        product *= shown.lengths[k]
        total = product if total is None else np.add(total, product, out=total)
        yield (total / (norms[k] * shown.norms[k])).astype(np.float32)


def exact_ranks(
    asked: np.ndarray, targets: np.ndarray, database: Iterable[np.ndarray], widths: Sequence[int]
) -> Ranks:
    """Count, for every query and width, the frames that score above and as its target does.

    Args:
        asked: (queries, entries) fp32 embeddings, finite.
        targets: (queries, entries) those of each query's target, which is in the database.
        database: (some frames, entries) each, in whatever order and numbers; one at a time is held.
        widths: widest first.
    """
    began = time.perf_counter()
    queries = Cut(asked, widths)
    gold = list(pair_scores(queries, Cut(targets, widths)))
    counts = np.zeros((2, len(widths), len(asked)), np.int64)
    frames = 0
    for shown in blocks(database, widths):
        frames += len(shown)
        for start in range(0, len(asked), QUERIES):
            some = slice(start, start + QUERIES)
            for k, scores in enumerate(block_scores(queries[some], shown)):
                counts[:, k, some] += count_above_and_equal(scores, gold[k][some])
    greater, equal = counts[:, ::-1]
    # The target itself is among those that score as it does.
    found = np.ones(greater.shape, bool)
    sizes = tuple(frames * width * FP32 for width in widths)
    seconds = (time.perf_counter() - began,) * len(widths)
    return Ranks(tuple(widths), greater, equal - 1, found, frames, sizes, seconds)


def least_of_top(
    asked: np.ndarray, database: Iterable[np.ndarray], widths: Sequence[int], ks: Sequence[int]
) -> np.ndarray:
    """The k-th highest score of each query's whole ranking: (widths, ks, queries) fp32, widest
    first; -inf where the database has fewer frames."""
    queries = Cut(asked, widths)
    best = [np.full((len(asked), max(ks)), -np.inf, np.float32) for _ in widths]
    for shown in blocks(database, widths):
        for k, scores in enumerate(block_scores(queries, shown)):
            both = np.concatenate([best[k], scores], axis=1)
            best[k] = np.partition(both, -max(ks), axis=1)[:, -max(ks) :]
    falling = np.sort(np.stack(best[::-1]), axis=2)[:, :, ::-1]
    return falling[:, :, [k - 1 for k in ks]].transpose(0, 2, 1)


def blocks(database: Iterable[np.ndarray], widths: Sequence[int]) -> Iterator[Cut]:
    for part in database:
        for start in range(0, len(part), FRAMES):
            yield Cut(part[start : start + FRAMES], widths)
