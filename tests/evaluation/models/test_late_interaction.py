"""Ranks by late interaction equal those of the library, in any order, blocks and padding."""

from __future__ import annotations

import numpy as np
import pytest
from sentence_transformers.util.similarity import maxsim

from dynapix.evaluation.embedders.cache import pad_rows
from dynapix.evaluation.retrieval import late_interaction
from dynapix.evaluation.retrieval.late_interaction import late_ranks, pair_scores
from tests.evaluation.metrics.reference import count_ranks

WIDTH = 24


def random_vectors(rows: int, most: int, seed: int) -> list[np.ndarray]:
    """Random unit vectors: for each row, from one to `most` of them."""
    rng = np.random.default_rng(seed)
    vectors = [rng.standard_normal((rng.integers(1, most + 1), WIDTH)) for _ in range(rows)]
    return [(v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in vectors]


def rows_of(vectors: list[np.ndarray], more: int = 0) -> np.ndarray:
    """Stack the vectors of each row, padded by `more` vectors beyond the longest row."""
    rows = pad_rows([v.ravel() for v in vectors])
    return np.pad(rows, ((0, 0), (0, more * WIDTH)))


@pytest.fixture(scope="module")
def queries() -> list[np.ndarray]:
    return random_vectors(20, 60, 0)


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Vectors of 120 frames, of which every third equals the first."""
    vectors = random_vectors(120, 9, 1)
    return [vectors[0] if k % 3 == 0 else v for k, v in enumerate(vectors)]


TARGETS = np.arange(20) * 5


def ranks(queries, frames, targets=TARGETS, size=120, more=0):
    rows = rows_of(frames, more)
    parts = [rows[k : k + size] for k in range(0, len(rows), size)]
    return late_ranks(rows_of(queries, more), rows[targets], parts, WIDTH)


def same(one, two) -> bool:
    return np.array_equal(one.above, two.above) and np.array_equal(one.tied, two.tied)


def test_ranks_agree_with_the_librarys_scores(queries, frames) -> None:
    scores = maxsim([*queries], [*frames]).numpy()
    pairs = pair_scores(rows_of(queries), rows_of(frames)[TARGETS], WIDTH)
    np.testing.assert_allclose(pairs, scores[np.arange(20), TARGETS], rtol=1e-6, atol=1e-5)
    found = ranks(queries, frames)
    above, _ = count_ranks(scores, TARGETS)
    # The library computes in fp32, where the scores of equal frames may differ.
    assert (found.above[0] <= above).all()
    assert (found.above[0] + found.tied[0] >= above).all()
    copies = TARGETS % 3 == 0
    assert np.array_equal(found.tied[0][copies], np.full(copies.sum(), 39))
    assert np.array_equal(found.above[0][~copies], above[~copies])
    assert not found.tied[0][~copies].any()


def test_twins_are_compared_with_targets(queries, frames) -> None:
    """A frame is its own best match, and equal frames tie."""
    rows = rows_of(frames)
    # Every third frame equals the first.
    cases = [(1, 1, 2, 0), (1, 2, 1, 1), (1, 2, 2, 0.5), (1, 0, 3, 0.5)]
    for query, target, twin, expected in cases:
        found = late_ranks(rows[[query]], rows[[target]], [rows], WIDTH, rows[[twin]])
        assert found.twin_above.tolist() == [[expected]]


@pytest.mark.parametrize(("size", "block", "cells"), [(1, 9, 1), (7, 64, 2**10), (50, 1, 2**23)])
def test_blocks_do_not_change_ranks(monkeypatch, queries, frames, size, block, cells) -> None:
    expected = ranks(queries, frames)
    monkeypatch.setattr(late_interaction, "BLOCK_VECTORS", block)
    monkeypatch.setattr(late_interaction, "BLOCK_PRODUCTS", cells)
    assert same(ranks(queries, frames, size=size), expected)


def test_the_order_of_vectors_does_not_change_scores(queries, frames) -> None:
    rng = np.random.default_rng(2)
    moved = [[rng.permutation(v) for v in side] for side in (queries, frames)]
    one = pair_scores(rows_of(queries), rows_of(frames)[TARGETS], WIDTH)
    two = pair_scores(rows_of(moved[0]), rows_of(moved[1])[TARGETS], WIDTH)
    assert np.array_equal(one, two)
    assert same(ranks(*moved), ranks(queries, frames))


def test_the_order_of_the_database_does_not_change_ranks(queries, frames) -> None:
    places = np.random.default_rng(3).permutation(120)
    moved = ranks(queries, [frames[k] for k in places], np.argsort(places)[TARGETS], size=13)
    assert same(moved, ranks(queries, frames))


def test_padding_changes_no_rank_and_is_not_counted(queries, frames) -> None:
    padded = ranks(queries, frames, more=5)
    assert same(padded, ranks(queries, frames))
    assert padded.vectors == sum(map(len, frames))


def test_sums_of_up_to_8000_vectors_are_exact() -> None:
    """All vectors are equal, which gives the largest possible sum."""
    vector = np.full((1, WIDTH), WIDTH**-0.5, np.float32)
    steps = np.rint(vector.astype(np.float64) * late_interaction.GRID).astype(object)
    for count in (1, 7999, 8000):
        query = np.repeat(vector, count, axis=0).reshape(1, -1)
        (score,) = pair_scores(query, vector, WIDTH)
        exact = count * int((steps * steps).sum())
        assert exact < 2**53
        assert score == np.float32(exact / 2**40)
