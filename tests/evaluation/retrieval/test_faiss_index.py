"""The approximate index: what it gives, how it is held against exact ranks, and when it is refused.

Needs faiss, which the extra `test` brings.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from evaluation.embedders.cache import EmbeddingCache
from evaluation.retrieval import faiss_index
from evaluation.retrieval.exact_search import exact_ranks
from evaluation.retrieval.faiss_index import IndexResult, approximate_ranks, ranks_of_results
from tests.user_errors import raises_user_error

WIDTHS = [32, 8]
NAMES = [f"scene/{k}" for k in range(900)]
VECTORS = np.random.default_rng(0).standard_normal((900, 32), np.float32)
ASKED = VECTORS[:40] + 0.3 * np.random.default_rng(1).standard_normal((40, 32), np.float32)
EVERY = 10**6


def embeddings(folder: Path, model: str = "one") -> EmbeddingCache:
    kept = EmbeddingCache(folder, "frame", {"weights": model})
    kept.complete(dict(zip(NAMES, range(900), strict=True)), lambda some: VECTORS[some], 64)
    return kept


def ranks(folder: Path, probes: int, model: str = "one"):
    return approximate_ranks(ASKED, NAMES[:40], embeddings(folder, model), NAMES, WIDTHS, probes, 0)


def test_through_all_lists_it_ranks_nearly_as_exactly(tmp_path) -> None:
    found, told = ranks(tmp_path, EVERY)
    exact = exact_ranks(ASKED, VECTORS[:40], [VECTORS], WIDTHS)
    assert found.found.all()
    # A byte an entry moves a score by less than a hundredth.
    assert np.abs(found.greater[0] - exact.greater[0]).max() <= 3
    assert [t["width"] for t in told] == WIDTHS
    for of_width in told:
        assert all(of_width[f"recall@{k}"] > 0.9 for k in (1, 10, 50))


def test_fewer_lists_lose_more(tmp_path) -> None:
    found, told = ranks(tmp_path, 1)
    _, every = ranks(tmp_path, EVERY)
    assert not found.found.all()
    assert told[0]["recall@50"] < 0.5 < every[0]["recall@50"]


def test_an_index_is_kept(tmp_path, monkeypatch) -> None:
    _, first = ranks(tmp_path, 4)
    monkeypatch.setattr(faiss_index, "_build", None)
    _, again = ranks(tmp_path, 4)
    without_time = [[{**t, "seconds": 0} for t in told] for told in (first, again)]
    assert without_time[0] == without_time[1]


def test_indexes_of_other_models_and_faiss_versions_are_separate(tmp_path, monkeypatch) -> None:
    def indexes() -> set[str]:
        return {path.name for path in tmp_path.rglob("*.faiss")}

    ranks(tmp_path, 4)
    first = indexes()
    ranks(tmp_path, 4, "another")
    second = indexes() - first
    monkeypatch.setattr(faiss_index.import_faiss(), "__version__", "1.0")
    ranks(tmp_path, 4)
    assert len(first) == len(second) == len(indexes() - first - second) == len(WIDTHS)


def test_a_killed_build_is_repeated(tmp_path) -> None:
    _, first = ranks(tmp_path, 4)
    for path in (embeddings(tmp_path).folder / "index").glob("*.faiss"):
        path.with_suffix(".partial").write_bytes(b"torn")
        path.unlink()
    _, again = ranks(tmp_path, 4)
    assert [t["recall@10"] for t in again] == [t["recall@10"] for t in first]


def test_a_damaged_index_is_named(tmp_path) -> None:
    ranks(tmp_path, 4)
    for path in (embeddings(tmp_path).folder / "index").glob("*.faiss"):
        path.write_bytes(path.read_bytes()[:200])
    with raises_user_error("damaged-file", contains=".faiss"):
        ranks(tmp_path, 4)


def test_ranks_are_counted_among_what_was_found() -> None:
    frames = np.array([[7, 3, 5, -1], [7, 3, 5, 2], [7, 3, -1, -1]])
    scores = np.array([[0.9, 0.8, 0.8, -9], [0.9, 0.8, 0.8, 0.1], [0.9, 0.8, -9, -9]])
    found = ranks_of_results([IndexResult(frames, scores, 0, 0)], np.array([5, 7, 4]), [8], 900)
    assert found.greater.tolist() == [[1, 0, 0]]
    assert found.tied.tolist() == [[1, 0, 0]]
    assert found.found.tolist() == [[True, True, False]]


def test_without_faiss_it_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    with raises_user_error("missing-package", contains="[index]"):
        faiss_index.import_faiss()
