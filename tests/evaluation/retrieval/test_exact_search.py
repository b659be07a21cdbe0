"""Exact ranks are those of one plain table of scores, however the database is cut and ordered."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.metrics.ranking import count_ranks
from evaluation.retrieval import exact_search
from evaluation.retrieval.exact_search import (
    GridEmbeddings,
    block_scores,
    exact_ranks,
    kth_scores,
    pair_scores,
    row_sums,
)

WIDTHS = (96, 48, 20, 7)


def embeddings(rows: int, seed: int = 0) -> np.ndarray:
    """Rows of very different lengths, some with a first piece next to nothing."""
    rng = np.random.default_rng(seed)
    made = rng.standard_normal((rows, WIDTHS[0])) * 10.0 ** rng.uniform(-3, 3, (rows, 1))
    made[::5, :7] *= 1e-6
    return made.astype(np.float32)


def cosines(asked: np.ndarray, shown: np.ndarray, width: int) -> np.ndarray:
    """In double precision, straight from the definition."""
    units = [
        a[:, :width].astype(float) / np.linalg.norm(a[:, :width].astype(float), axis=1)[:, None]
        for a in (asked, shown)
    ]
    return units[0] @ units[1].T


def split(database: np.ndarray, size: int) -> list[np.ndarray]:
    return [database[k : k + size] for k in range(0, len(database), size)]


def same(one: exact_search.Ranks, two: exact_search.Ranks) -> bool:
    return (
        np.array_equal(one.greater, two.greater)
        and np.array_equal(one.tied, two.tied)
        and one.frames == two.frames
    )


def test_scores_are_cosines_to_fp32() -> None:
    asked, shown = embeddings(30), embeddings(50, 1)
    for k, scores in enumerate(
        block_scores(GridEmbeddings(asked, WIDTHS), GridEmbeddings(shown, WIDTHS))
    ):
        assert scores.dtype == np.float32
        np.testing.assert_allclose(scores, cosines(asked, shown, WIDTHS[::-1][k]), atol=6e-8)


def test_ranks_are_those_of_a_plain_table() -> None:
    asked, shown = embeddings(40), embeddings(300, 1)
    gold = np.random.default_rng(2).integers(300, size=40)
    found = exact_ranks(asked, shown[gold], [shown], WIDTHS)
    for k, width in enumerate(WIDTHS):
        greater, tied = count_ranks(cosines(asked, shown, width), gold)
        # fp32 cannot tell a few pairs apart that double precision can.
        assert np.abs(found.greater[k] - greater).max() <= 1
        assert (found.greater[k] + found.tied[k] >= greater).all()
        assert (found.tied[k] >= tied).all()
    assert found.tied.sum() < 5


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64, 255, 299, 300])
@pytest.mark.parametrize("block", [1, 5, 37, 1024])
def test_no_cut_of_the_database_changes_a_rank(monkeypatch, size, block) -> None:
    asked, shown = embeddings(23), embeddings(300, 1)
    shown[::3] = shown[0]
    gold = np.arange(23) * 11
    whole = exact_ranks(asked, shown[gold], [shown], WIDTHS)
    monkeypatch.setattr(exact_search, "FRAMES", block)
    monkeypatch.setattr(exact_search, "QUERIES", 1 + block % 9)
    assert same(exact_ranks(asked, shown[gold], split(shown, size), WIDTHS), whole)


def test_no_order_of_the_database_or_of_the_queries_changes_a_rank() -> None:
    asked, shown = embeddings(40), embeddings(333, 1)
    shown[100:200] = shown[:100]
    gold = np.arange(40) * 8
    whole = exact_ranks(asked, shown[gold], [shown], WIDTHS)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        frames, queries = rng.permutation(333), rng.permutation(40)
        moved = exact_ranks(asked[queries], shown[gold[queries]], split(shown[frames], 101), WIDTHS)
        assert np.array_equal(moved.greater, whole.greater[:, queries])
        assert np.array_equal(moved.tied, whole.tied[:, queries])


@pytest.mark.parametrize("size", [1, 13, 64, 129])
def test_equal_frames_tie_wherever_they_stand(size) -> None:
    """Three copies of every frame, in other chunks and at other places of a chunk."""
    asked, once = embeddings(64), embeddings(129, 1)
    shown = np.concatenate([once, once[::-1], np.roll(once, 17, axis=0)])
    gold = np.arange(64)
    alone = exact_ranks(asked, once[gold], [once], WIDTHS)
    assert not alone.tied.any()
    found = exact_ranks(asked, shown[gold], split(shown, size), WIDTHS)
    assert (found.tied == 2).all()
    assert np.array_equal(found.greater, 3 * alone.greater)


def test_a_pairs_score_is_its_blocks_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    asked = rng.standard_normal((70, 1024), np.float32)
    shown = rng.standard_normal((70, 1024), np.float32)
    queries, frames = GridEmbeddings(asked, [1024, 256]), GridEmbeddings(shown, [1024, 256])
    blocks = list(block_scores(queries, frames))
    for pairs, block in zip(pair_scores(queries, frames), blocks, strict=True):
        assert np.array_equal(pairs, np.diagonal(block))
    for rows in (slice(3, 4), slice(9, 22), np.array([5, 68, 2])):
        for part, block in zip(block_scores(queries[rows], frames), blocks, strict=True):
            assert np.array_equal(part, block[rows])


def test_products_of_pieces_are_exact() -> None:
    """The law that all others rest on, held against whole numbers without a bound, for vectors
    whose products all add up in one direction too."""
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((4, 4096))
    rows[1], rows[2] = 1.0, np.abs(rows[2])
    rows[3, 1:] = 0
    (piece,) = GridEmbeddings(rows.astype(np.float32), [4096]).pieces
    products = piece @ piece.T
    whole = [[int(x) for x in row] for row in piece.tolist()]
    for i, a in enumerate(whole):
        for j, b in enumerate(whole):
            assert int(products[i, j]) == sum(x * y for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("width", [1, 2, 3, 7, 64, 100])
def test_a_rows_sum_is_the_same_beside_any_others(width) -> None:
    values = np.random.default_rng(0).random((50, width))
    sums = row_sums(values.copy())
    np.testing.assert_allclose(sums, values.sum(1))
    for k in range(50):
        assert row_sums(values[k : k + 1].copy()) == sums[k]
        assert row_sums(np.asfortranarray(values)[k:].copy(order="F"))[0] == sums[k]


def test_an_embedding_of_zeros_is_as_near_to_all() -> None:
    shown = embeddings(10)
    shown[4] = 0
    found = exact_ranks(np.zeros((1, 96), np.float32), shown[:1], [shown], WIDTHS)
    assert (found.greater == 0).all()
    assert (found.tied == 9).all()


def test_the_least_of_the_first_k_is_the_kth_highest(monkeypatch) -> None:
    asked, shown = embeddings(9), embeddings(120, 1)
    monkeypatch.setattr(exact_search, "FRAMES", 11)
    least = kth_scores(asked, split(shown, 50), WIDTHS, (1, 10, 200))
    for k, width in enumerate(WIDTHS):
        falling = -np.sort(-cosines(asked, shown, width), axis=1)
        np.testing.assert_allclose(least[k, 0], falling[:, 0], atol=6e-8)
        np.testing.assert_allclose(least[k, 1], falling[:, 9], atol=6e-8)
    assert np.isneginf(least[:, 2]).all()
