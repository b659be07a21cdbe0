"""Exact ranks equal those of a score matrix, in any order and blocks of the database: for one
vector per frame, and for several vectors by late interaction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from sentence_transformers.util.similarity import maxsim

from dynapix.evaluation.embedders.cache import pad_rows
from dynapix.evaluation.retrieval import exact_search
from dynapix.evaluation.retrieval.exact_search import (
    LATE_GRID,
    Ranks,
    exact_ranks,
    pair_scores,
    score,
    to_grid,
)
from tests.evaluation.metrics.reference import count_ranks

WIDTHS = (96, 48, 20, 7)
LATE_WIDTH = 24
QUERIES, FRAMES = 40, 300
TARGETS = np.arange(QUERIES) * 7


def embeddings(rows: int, seed: int = 0) -> np.ndarray:
    """Random embeddings of very different lengths, some of which have tiny first entries."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((rows, WIDTHS[0])) * 10.0 ** rng.uniform(-3, 3, (rows, 1))
    values[::5, :7] *= 1e-6
    return values.astype(np.float32)


def random_vectors(rows: int, most: int, seed: int) -> list[np.ndarray]:
    """Random unit vectors: for each row, from one to `most` of them."""
    rng = np.random.default_rng(seed)
    vectors = [rng.standard_normal((rng.integers(1, most + 1), LATE_WIDTH)) for _ in range(rows)]
    return [(v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in vectors]


def rows_of(vectors: list[np.ndarray], more: int = 0) -> np.ndarray:
    """Stack the vectors of each row, padded by `more` vectors beyond the longest row."""
    rows = pad_rows([v.ravel() for v in vectors])
    return np.pad(rows, ((0, 0), (0, more * LATE_WIDTH)))


@dataclass
class Case:
    """Rows of queries and frames, in which every third frame equals the first."""

    queries: np.ndarray
    frames: np.ndarray
    widths: tuple[int, ...]
    late: bool

    def ranks(self, frames: np.ndarray, targets: np.ndarray, size: int = FRAMES) -> Ranks:
        """Rank frames in parts of a size. `targets` are their indices of the targets."""
        parts = [frames[k : k + size] for k in range(0, len(frames), size)]
        return exact_ranks(self.queries, frames[targets], parts, self.widths, late=self.late)


@pytest.fixture(params=["single", "late"])
def case(request) -> Case:
    if request.param == "single":
        queries, frames = embeddings(QUERIES), embeddings(FRAMES, 1)
        frames[::3] = frames[0]
        return Case(queries, frames, WIDTHS, late=False)
    vectors = random_vectors(FRAMES, 9, 1)
    vectors = [vectors[0] if k % 3 == 0 else v for k, v in enumerate(vectors)]
    queries = rows_of(random_vectors(QUERIES, 20, 0))
    return Case(queries, rows_of(vectors), (LATE_WIDTH,), late=True)


def same(one: Ranks, two: Ranks) -> bool:
    return np.array_equal(one.above, two.above) and np.array_equal(one.tied, two.tied)


def exact_cosines(queries: np.ndarray, database: np.ndarray, width: int) -> np.ndarray:
    """Cosines (queries, frames) by their definition, in double precision."""
    units = [
        a[:, :width].astype(float) / np.linalg.norm(a[:, :width].astype(float), axis=1)[:, None]
        for a in (queries, database)
    ]
    return units[0] @ units[1].T


@pytest.mark.parametrize(("size", "block", "cells"), [(1, 9, 1), (7, 64, 2**10), (299, 1, 2**23)])
def test_blocks_do_not_change_ranks(monkeypatch, case, size, block, cells) -> None:
    expected = case.ranks(case.frames, TARGETS)
    monkeypatch.setattr(exact_search, "BLOCK_ENTRIES", block * case.frames.shape[1])
    monkeypatch.setattr(exact_search, "BLOCK_PRODUCTS", cells)
    assert same(case.ranks(case.frames, TARGETS, size), expected)


def test_the_order_of_the_database_does_not_change_ranks(case) -> None:
    places = np.random.default_rng(3).permutation(FRAMES)
    moved = case.ranks(case.frames[places], np.argsort(places)[TARGETS], 13)
    assert same(moved, case.ranks(case.frames, TARGETS))


def test_equal_frames_tie(case) -> None:
    found = case.ranks(case.frames, TARGETS)
    copies = TARGETS % 3 == 0
    assert (found.tied[:, copies] == FRAMES // 3 - 1).all()
    assert not found.tied[:, ~copies].any()
    # Each copy of the database adds as many frames above a target.
    double = case.ranks(np.concatenate([case.frames, case.frames[::-1]]), TARGETS, 101)
    assert np.array_equal(double.above, 2 * found.above)


def score_rows(
    queries: np.ndarray, frames: np.ndarray, width: int, late: bool = False
) -> np.ndarray:
    return score(to_grid(queries, width, late), to_grid(frames, width, late))


def test_scores_of_pairs_and_of_blocks_are_bit_identical(case) -> None:
    frames = case.frames[TARGETS]
    for width in case.widths:
        block = score_rows(case.queries, frames, width, case.late)
        assert block.dtype == np.float32
        pairs = pair_scores(case.queries, frames, width, case.late)
        assert np.array_equal(pairs, np.diagonal(block))
        for rows in (slice(3, 4), slice(9, 22), np.array([5, 38, 2])):
            part = score_rows(case.queries[rows], frames, width, case.late)
            assert np.array_equal(part, block[rows])


@pytest.mark.parametrize("width", WIDTHS)
def test_scores_are_cosines_to_fp32(width) -> None:
    queries, database = embeddings(30), embeddings(50, 1)
    scores = score_rows(queries, database, width, late=False)
    np.testing.assert_allclose(scores, exact_cosines(queries, database, width), atol=6e-8)


def test_ranks_equal_those_of_a_score_matrix() -> None:
    queries, database = embeddings(QUERIES), embeddings(FRAMES, 1)
    found = exact_ranks(queries, database[TARGETS], [database], WIDTHS)
    for k, width in enumerate(WIDTHS):
        above, tied = count_ranks(exact_cosines(queries, database, width), TARGETS)
        # A few frames tie with the target in fp32 but not in double precision.
        assert np.abs(found.above[k] - above).max() <= 1
        assert (found.above[k] + found.tied[k] >= above).all()
        assert (found.tied[k] >= tied).all()
    assert found.tied.sum() < 5


def test_twins_are_compared_with_targets_at_each_width() -> None:
    queries, database = embeddings(400), embeddings(800, 1)
    targets, twins = database[:400], database[400:]

    def share(rows: np.ndarray) -> np.ndarray:
        return exact_ranks(rows, targets, [database], WIDTHS, twins).twin_above

    assert (share(targets) == 0).all(), "embeddings of the counterfactual frames"
    assert (share(twins) == 1).all(), "embeddings of the factual frames"
    assert (share(np.zeros_like(queries)) == 0.5).all()
    for k, width in enumerate(WIDTHS):
        scores = exact_cosines(queries, database, width)
        clear = np.abs(gap := np.diagonal(scores[:, 400:]) - np.diagonal(scores)) > 1e-6
        assert np.array_equal(share(queries)[k][clear], (gap > 0)[clear])
    assert exact_ranks(queries, targets, [database], WIDTHS).twin_above is None


def test_products_on_the_grid_are_exact() -> None:
    """The products equal those of Python's integers, also if all products of entries are
    positive."""
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((4, 4096))
    rows[1], rows[2] = 1.0, np.abs(rows[2])
    rows[3, 1:] = 0
    grid = to_grid(rows.astype(np.float32), 4096)
    products = grid @ grid.T
    integers = [[int(x) for x in row] for row in grid.tolist()]
    for i, a in enumerate(integers):
        for j, b in enumerate(integers):
            assert int(products[i, j]) == sum(x * y for x, y in zip(a, b, strict=True))


def test_an_embedding_of_zeros_ties_with_all_frames() -> None:
    database = embeddings(10)
    database[4] = 0
    found = exact_ranks(np.zeros((1, 96), np.float32), database[:1], [database], WIDTHS)
    assert (found.above == 0).all()
    assert (found.tied == 9).all()


def test_late_scores_agree_with_the_librarys_in_any_order_of_the_vectors() -> None:
    queries, frames = random_vectors(20, 60, 0), random_vectors(120, 9, 1)
    found = score_rows(rows_of(queries), rows_of(frames), LATE_WIDTH, late=True)
    np.testing.assert_allclose(found, maxsim([*queries], [*frames]).numpy(), rtol=1e-6, atol=1e-5)
    rng = np.random.default_rng(2)
    moved = [rows_of([rng.permutation(v) for v in side], 5) for side in (queries, frames)]
    assert np.array_equal(score_rows(*moved, LATE_WIDTH, late=True), found)
    padded = exact_ranks(moved[0], moved[1][:20], [moved[1]], [LATE_WIDTH], late=True)
    assert padded.vectors == sum(map(len, frames)), "padding is not counted"


def test_sums_of_up_to_8000_vectors_are_exact() -> None:
    """All vectors are equal, which gives the largest possible sum."""
    vector = np.full((1, LATE_WIDTH), LATE_WIDTH**-0.5, np.float32)
    steps = np.rint(vector.astype(np.float64) * LATE_GRID).astype(object)
    for count in (1, 7999, 8000):
        query = np.repeat(vector, count, axis=0).reshape(1, -1)
        (found,) = pair_scores(query, vector, LATE_WIDTH, late=True)
        exact = count * int((steps * steps).sum())
        assert exact < 2**53
        assert found == np.float32(exact / 2**40)
