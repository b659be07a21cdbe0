"""Exact ranks equal those of a score matrix, in any order and blocks of the database: for one
vector per frame, and for several vectors by late interaction."""

from __future__ import annotations

import numpy as np
import pytest
from sentence_transformers.util.similarity import maxsim

from dynapix.evaluation.embedders.cache import pad_rows
from dynapix.evaluation.retrieval import exact_search
from dynapix.evaluation.retrieval.exact_search import (
    LATE_GRID,
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


def exact_cosines(queries: np.ndarray, database: np.ndarray, width: int) -> np.ndarray:
    """Cosines (queries, frames) by their definition, in double precision."""
    rows = [a[:, :width].astype(float) for a in (queries, database)]
    one, two = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in rows)
    return one @ two.T


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(("size", "block", "cells"), [(1, 9, 1), (7, 64, 2**10), (299, 1, 2**23)])
def test_order_and_blocks_do_not_change_ranks(monkeypatch, late, size, block, cells) -> None:
    """Every third frame equals the first. These tie only if scores have the same bits in any block
    and as those of a query and its target alone."""
    if late:
        queries, frames = rows_of(random_vectors(QUERIES, 20, 0)), random_vectors(FRAMES, 9, 1)
        frames = rows_of([frames[k if k % 3 else 0] for k in range(FRAMES)])
    else:
        queries, frames = embeddings(QUERIES), embeddings(FRAMES, 1)
        frames[::3] = frames[0]
    widths = (LATE_WIDTH,) if late else WIDTHS
    expected = exact_ranks(queries, frames[TARGETS], [frames], widths, late=late)
    copies = TARGETS % 3 == 0
    assert (expected.tied[:, copies] == FRAMES // 3 - 1).all()
    assert not expected.tied[:, ~copies].any()
    monkeypatch.setattr(exact_search, "BLOCK_ENTRIES", block * frames.shape[1])
    monkeypatch.setattr(exact_search, "BLOCK_PRODUCTS", cells)
    moved = np.random.default_rng(3).permutation(frames)
    parts = [moved[k : k + size] for k in range(0, FRAMES, size)]
    found = exact_ranks(queries, frames[TARGETS], parts, widths, late=late)
    assert np.array_equal(found.above, expected.above)
    assert np.array_equal(found.tied, expected.tied)


def test_scores_are_cosines_and_ranks_those_of_a_score_matrix() -> None:
    queries, database = embeddings(QUERIES + 1), embeddings(FRAMES, 1)
    # An embedding of zeros ties with all frames.
    queries[-1] = 0
    found = exact_ranks(queries, database[[*TARGETS, 0]], [database], WIDTHS)
    assert (found.above[:, -1] == 0).all()
    assert (found.tied[:, -1] == FRAMES - 1).all()
    for k, width in enumerate(WIDTHS):
        cosines = exact_cosines(queries[:-1], database, width)
        scores = score(to_grid(queries[:-1], width), to_grid(database, width))
        np.testing.assert_allclose(scores, cosines, atol=6e-8)
        above, tied = count_ranks(cosines, TARGETS)
        # A few frames tie with the target in fp32 but not in double precision.
        own_above, own_tied = found.above[k, :-1], found.tied[k, :-1]
        assert np.abs(own_above - above).max() <= 1
        assert (own_above + own_tied >= above).all()
        assert (own_tied >= tied).all()
    assert found.tied[:, :-1].sum() < 5


def test_twins_are_compared_with_targets_at_each_width() -> None:
    queries, database = embeddings(400), embeddings(800, 1)
    queries[0], queries[1], queries[2] = database[0], database[401], 0
    found = exact_ranks(queries, database[:400], [database], WIDTHS, database[400:]).twin_above
    # The embedding of the counterfactual frame, that of the factual frame, and one of zeros.
    assert found[:, :3].tolist() == [[0, 1, 0.5]] * len(WIDTHS)
    for k, width in enumerate(WIDTHS):
        scores = exact_cosines(queries[3:], database, width)
        rows = np.arange(397)
        gap = scores[rows, rows + 403] - scores[rows, rows + 3]
        clear = np.abs(gap) > 1e-6
        assert np.array_equal(found[k, 3:][clear], (gap > 0)[clear])


def test_late_scores_agree_with_the_librarys_in_any_order_of_the_vectors() -> None:
    queries, frames = random_vectors(20, 60, 0), random_vectors(120, 9, 1)
    rows = rows_of(queries), rows_of(frames)
    found = score(*(to_grid(side, LATE_WIDTH, late=True) for side in rows))
    np.testing.assert_allclose(found, maxsim([*queries], [*frames]).numpy(), rtol=1e-6, atol=1e-5)
    rng = np.random.default_rng(2)
    moved = [rows_of([rng.permutation(v) for v in side], 5) for side in (queries, frames)]
    again = score(*(to_grid(side, LATE_WIDTH, late=True) for side in moved))
    assert np.array_equal(again, found)
    padded = exact_ranks(moved[0], moved[1][:20], [moved[1]], [LATE_WIDTH], late=True)
    assert padded.vectors == sum(map(len, frames)), "padding is not counted"


def test_the_largest_sums_are_exact() -> None:
    """Equal vectors with equal entries give the largest sums."""
    grid = to_grid(np.ones((1, 4096), np.float32), 4096)
    exact = sum(int(x) ** 2 for x in grid[0])
    assert int((grid @ grid.T)[0, 0]) == exact < 2**53
    vector = np.full((1, LATE_WIDTH), LATE_WIDTH**-0.5, np.float32)
    steps = np.rint(vector.astype(np.float64) * LATE_GRID).astype(object)
    for count in (1, 7999, 8000):
        query = np.repeat(vector, count, axis=0).reshape(1, -1)
        (found,) = pair_scores(query, vector, LATE_WIDTH, late=True)
        assert (exact := count * int((steps * steps).sum())) < 2**53
        assert found == np.float32(exact / 2**40)
