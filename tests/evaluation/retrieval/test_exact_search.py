"""Exact ranks equal those of a score matrix, in any order and blocks of the database."""

from __future__ import annotations

import numpy as np
import pytest

from dynapix.evaluation.retrieval import exact_search
from dynapix.evaluation.retrieval.exact_search import (
    GridEmbeddings,
    block_scores,
    exact_ranks,
    pair_scores,
    row_sums,
)
from tests.evaluation.metrics.reference import count_ranks

WIDTHS = (96, 48, 20, 7)


def embeddings(rows: int, seed: int = 0) -> np.ndarray:
    """Random embeddings of very different lengths, some of which have tiny first entries."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((rows, WIDTHS[0])) * 10.0 ** rng.uniform(-3, 3, (rows, 1))
    values[::5, :7] *= 1e-6
    return values.astype(np.float32)


def cosines(queries: np.ndarray, database: np.ndarray, width: int) -> np.ndarray:
    """Cosines (queries, frames) by their definition, in double precision."""
    units = [
        a[:, :width].astype(float) / np.linalg.norm(a[:, :width].astype(float), axis=1)[:, None]
        for a in (queries, database)
    ]
    return units[0] @ units[1].T


def split(database: np.ndarray, size: int) -> list[np.ndarray]:
    return [database[k : k + size] for k in range(0, len(database), size)]


def same(one: exact_search.Ranks, two: exact_search.Ranks) -> bool:
    return (
        np.array_equal(one.above, two.above)
        and np.array_equal(one.tied, two.tied)
        and one.frames == two.frames
    )


def test_scores_are_cosines_to_fp32() -> None:
    queries, database = embeddings(30), embeddings(50, 1)
    for k, scores in enumerate(
        block_scores(GridEmbeddings(queries, WIDTHS), GridEmbeddings(database, WIDTHS))
    ):
        assert scores.dtype == np.float32
        np.testing.assert_allclose(scores, cosines(queries, database, WIDTHS[::-1][k]), atol=6e-8)


def test_ranks_equal_those_of_a_score_matrix() -> None:
    queries, database = embeddings(40), embeddings(300, 1)
    targets = np.random.default_rng(2).integers(300, size=40)
    found = exact_ranks(queries, database[targets], [database], WIDTHS)
    for k, width in enumerate(WIDTHS):
        above, tied = count_ranks(cosines(queries, database, width), targets)
        # A few frames tie with the target in fp32 but not in double precision.
        assert np.abs(found.above[k] - above).max() <= 1
        assert (found.above[k] + found.tied[k] >= above).all()
        assert (found.tied[k] >= tied).all()
    assert found.tied.sum() < 5


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 255, 299, 300])
@pytest.mark.parametrize("block", [1, 5, 37, 1024])
def test_blocks_of_the_database_do_not_change_ranks(monkeypatch, size, block) -> None:
    queries, database = embeddings(23), embeddings(300, 1)
    database[::3] = database[0]
    targets = np.arange(23) * 11
    expected = exact_ranks(queries, database[targets], [database], WIDTHS)
    monkeypatch.setattr(exact_search, "BLOCK_FRAMES", block)
    monkeypatch.setattr(exact_search, "BLOCK_QUERIES", 1 + block % 9)
    assert same(exact_ranks(queries, database[targets], split(database, size), WIDTHS), expected)


def test_the_order_of_the_database_and_of_the_queries_does_not_change_ranks() -> None:
    queries, database = embeddings(40), embeddings(333, 1)
    database[100:200] = database[:100]
    targets = np.arange(40) * 8
    expected = exact_ranks(queries, database[targets], [database], WIDTHS)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        order, moved_queries = rng.permutation(333), rng.permutation(40)
        moved = exact_ranks(
            queries[moved_queries],
            database[targets[moved_queries]],
            split(database[order], 101),
            WIDTHS,
        )
        assert np.array_equal(moved.above, expected.above[:, moved_queries])
        assert np.array_equal(moved.tied, expected.tied[:, moved_queries])


@pytest.mark.parametrize("size", [1, 13, 64, 129])
def test_equal_frames_tie_at_any_position(size) -> None:
    """The database has three copies of every frame, in different blocks and at different positions
    in a block."""
    queries, frames = embeddings(64), embeddings(129, 1)
    database = np.concatenate([frames, frames[::-1], np.roll(frames, 17, axis=0)])
    targets = np.arange(64)
    distinct = exact_ranks(queries, frames[targets], [frames], WIDTHS)
    assert not distinct.tied.any()
    found = exact_ranks(queries, database[targets], split(database, size), WIDTHS)
    assert (found.tied == 2).all()
    assert np.array_equal(found.above, 3 * distinct.above)


def test_twins_are_compared_with_targets_at_each_width() -> None:
    queries, database = embeddings(400), embeddings(800, 1)
    targets, twins = database[:400], database[400:]

    def share(rows: np.ndarray) -> np.ndarray:
        found = exact_ranks(rows, targets, [database], WIDTHS, twins)
        assert same(found, exact_ranks(rows, targets, [database], WIDTHS))
        return found.twin_above

    assert (share(targets) == 0).all(), "embeddings of the counterfactual frames"
    assert (share(twins) == 1).all(), "embeddings of the factual frames"
    assert (share(np.zeros_like(queries)) == 0.5).all()
    assert share(queries).mean(axis=1) == pytest.approx([0.5] * len(WIDTHS), abs=0.1)
    for k, width in enumerate(WIDTHS):
        scores = cosines(queries, database, width)
        clear = np.abs(gap := np.diagonal(scores[:, 400:]) - np.diagonal(scores)) > 1e-6
        assert np.array_equal(share(queries)[k][clear], (gap > 0)[clear])
    assert exact_ranks(queries, targets, [database], WIDTHS).twin_above is None


def test_scores_of_pairs_and_of_blocks_are_bit_identical() -> None:
    rng = np.random.default_rng(0)
    queries = rng.standard_normal((70, 1024), np.float32)
    database = rng.standard_normal((70, 1024), np.float32)
    query_grid, frame_grid = (
        GridEmbeddings(queries, [1024, 256]),
        GridEmbeddings(database, [1024, 256]),
    )
    blocks = list(block_scores(query_grid, frame_grid))
    for pairs, block in zip(pair_scores(query_grid, frame_grid), blocks, strict=True):
        assert np.array_equal(pairs, np.diagonal(block))
    for rows in (slice(3, 4), slice(9, 22), np.array([5, 68, 2])):
        for part, block in zip(block_scores(query_grid[rows], frame_grid), blocks, strict=True):
            assert np.array_equal(part, block[rows])


def test_products_of_pieces_are_exact() -> None:
    """The products equal those of Python's integers, also if all products of entries are
    positive."""
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((4, 4096))
    rows[1], rows[2] = 1.0, np.abs(rows[2])
    rows[3, 1:] = 0
    (piece,) = GridEmbeddings(rows.astype(np.float32), [4096]).pieces
    products = piece @ piece.T
    integers = [[int(x) for x in row] for row in piece.tolist()]
    for i, a in enumerate(integers):
        for j, b in enumerate(integers):
            assert int(products[i, j]) == sum(x * y for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("width", [1, 2, 3, 7, 64, 100])
def test_the_sum_of_a_row_is_independent_of_other_rows(width) -> None:
    values = np.random.default_rng(0).random((50, width))
    sums = row_sums(values.copy())
    np.testing.assert_allclose(sums, values.sum(1))
    for k in range(50):
        assert row_sums(values[k : k + 1].copy()) == sums[k]
        assert row_sums(np.asfortranarray(values)[k:].copy(order="F"))[0] == sums[k]


def test_an_embedding_of_zeros_ties_with_all_frames() -> None:
    database = embeddings(10)
    database[4] = 0
    found = exact_ranks(np.zeros((1, 96), np.float32), database[:1], [database], WIDTHS)
    assert (found.above == 0).all()
    assert (found.tied == 9).all()
