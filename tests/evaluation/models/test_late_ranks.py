"""Ranks by late interaction are those of the definition, and exact: no order, cut or filling moves
one."""

from __future__ import annotations

import numpy as np
import pytest
from sentence_transformers.util.similarity import maxsim

from evaluation.embedders.cache import EmbeddingCache, pad_rows
from evaluation.metrics.ranking import count_ranks
from evaluation.retrieval import late_interaction
from evaluation.retrieval.late_interaction import late_ranks, pair_scores

WIDTH = 24


def vectors(rows: int, most: int, seed: int) -> list[np.ndarray]:
    """Unit vectors, from one up to `most` a row."""
    rng = np.random.default_rng(seed)
    made = [rng.standard_normal((rng.integers(1, most + 1), WIDTH)) for _ in range(rows)]
    return [(v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32) for v in made]


def rows_of(found: list[np.ndarray], more: int = 0) -> np.ndarray:
    """Filled up with zeros, `more` than has to be."""
    rows = pad_rows([v.reshape(1, -1) for v in found])
    return np.pad(rows, ((0, 0), (0, more * WIDTH)))


@pytest.fixture(scope="module")
def asked() -> list[np.ndarray]:
    return vectors(20, 60, 0)


@pytest.fixture(scope="module")
def shown() -> list[np.ndarray]:
    """Every third frame is the first one's."""
    made = vectors(120, 9, 1)
    return [made[0] if k % 3 == 0 else v for k, v in enumerate(made)]


GOLD = np.arange(20) * 5


def ranks(asked, shown, gold=GOLD, size=120, more=0):
    frames = rows_of(shown, more)
    parts = [frames[k : k + size] for k in range(0, len(frames), size)]
    return late_ranks(rows_of(asked, more), frames[gold], parts, WIDTH)


def same(one, two) -> bool:
    return np.array_equal(one.greater, two.greater) and np.array_equal(one.tied, two.tied)


def test_ranks_are_those_of_the_librarys_scores(asked, shown) -> None:
    scores = maxsim([*asked], [*shown]).numpy()
    frames = rows_of(shown)
    pairs = np.array(list(pair_scores(rows_of(asked), frames[GOLD], WIDTH)))[:, 0]
    np.testing.assert_allclose(pairs, scores[np.arange(20), GOLD], rtol=1e-6, atol=1e-5)
    found = ranks(asked, shown)
    greater, _ = count_ranks(scores, GOLD)
    # fp32 cannot tell a frame from its own copies.
    assert (found.greater[0] <= greater).all()
    assert (found.greater[0] + found.tied[0] >= greater).all()
    copies = GOLD % 3 == 0
    assert np.array_equal(found.tied[0][copies], np.full(copies.sum(), 39))
    assert np.array_equal(found.greater[0][~copies], greater[~copies])
    assert not found.tied[0][~copies].any()


def test_what_is_stored_is_counted_without_what_fills_it_up(asked, shown) -> None:
    count = sum(len(v) for v in shown)
    assert ranks(asked, shown, more=3).bytes == (count * WIDTH * 4,)


@pytest.mark.parametrize(("size", "block", "cells"), [(1, 9, 1), (7, 64, 2**10), (50, 1, 2**23)])
def test_no_cut_changes_a_rank(monkeypatch, asked, shown, size, block, cells) -> None:
    whole = ranks(asked, shown)
    monkeypatch.setattr(late_interaction, "VECTORS", block)
    monkeypatch.setattr(late_interaction, "CELLS", cells)
    assert same(ranks(asked, shown, size=size), whole)


def test_no_order_of_a_frames_or_a_querys_vectors_changes_a_score(asked, shown) -> None:
    rng = np.random.default_rng(2)
    moved = [[rng.permutation(v) for v in side] for side in (asked, shown)]
    one = list(pair_scores(rows_of(asked), rows_of(shown)[GOLD], WIDTH))
    two = list(pair_scores(rows_of(moved[0]), rows_of(moved[1])[GOLD], WIDTH))
    assert np.array_equal(one, two)
    assert same(ranks(*moved), ranks(asked, shown))


def test_no_order_of_the_database_changes_a_rank(asked, shown) -> None:
    places = np.random.default_rng(3).permutation(120)
    moved = ranks(asked, [shown[k] for k in places], np.argsort(places)[GOLD], size=13)
    assert same(moved, ranks(asked, shown))


def test_filling_up_changes_no_rank(asked, shown) -> None:
    assert same(ranks(asked, shown, more=5), ranks(asked, shown))


def test_sums_of_as_many_vectors_as_there_may_be_are_exact() -> None:
    """All of them alike, so that the sum is the largest there is."""
    vector = np.full((1, WIDTH), WIDTH**-0.5, np.float32)
    whole = np.rint(vector.astype(np.float64) * late_interaction.GRID).astype(object)
    for count in (1, 7999, 8000):
        query = np.repeat(vector, count, axis=0).reshape(1, -1)
        (score,) = pair_scores(query, vector, WIDTH)
        exact = count * int((whole * whole).sum())
        assert exact < 2**53
        assert score[0] == np.float32(exact / 2**40)


def test_rows_of_several_lengths_come_back_from_disk_pad_rows(tmp_path, asked) -> None:
    things = {f"q{k}": v.reshape(1, -1) for k, v in enumerate(asked)}
    kept = EmbeddingCache(tmp_path, "query", {"made by": "hand"})
    kept.complete(dict(list(things.items())[:7]), pad_rows, 3)
    kept.complete(things, pad_rows, 3)
    assert np.array_equal(kept.rows(list(things)), rows_of(asked))
