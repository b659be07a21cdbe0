"""Embeddings on disk: read back byte for byte, resumed after a kill, and refused if damaged."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dynapix.evaluation.embedders import cache
from dynapix.evaluation.embedders.cache import EmbeddingCache
from tests.user_errors import raises_user_error

SETTINGS = {"weights": "ab12", "image_size": 96}
INPUTS = {f"scene-{k:03d}/{k}": k for k in range(2500)}


class Model:
    """Embeds numbers and records them. The embeddings of the numbers in `bad` contain a NaN."""

    def __init__(self, bad: tuple[int, ...] = ()) -> None:
        self.inputs: list[int] = []
        self._bad = bad

    def __call__(self, some: list[int]) -> np.ndarray:
        self.inputs += some
        rows = np.stack([np.random.default_rng(k).random(8, np.float32) for k in some])
        rows[[k in self._bad for k in some], 3] = np.nan
        return rows


def filled(folder: Path) -> EmbeddingCache:
    embeddings = EmbeddingCache(folder, "frame", SETTINGS)
    embeddings.complete(INPUTS, Model(), 64)
    return embeddings


def test_embeddings_are_computed_once_and_read_back_byte_for_byte(tmp_path) -> None:
    model = Model()
    expected = Model()(list(INPUTS.values()))
    for _ in range(2):
        embeddings = EmbeddingCache(tmp_path, "frame", SETTINGS)
        embeddings.complete(INPUTS, model, 64)
        assert embeddings.rows(list(INPUTS)).tobytes() == expected.tobytes()
        assert embeddings.width == 8
    assert model.inputs == list(INPUTS.values())


def test_parts_hold_each_requested_embedding_once(tmp_path) -> None:
    embeddings = filled(tmp_path)
    names = list(INPUTS)[::-7]
    parts = list(embeddings.parts(names))
    assert max(map(len, parts)) <= cache.PART_ROWS
    found, expected = np.concatenate(parts), embeddings.rows(names)
    assert np.array_equal(np.sort(found, axis=0), np.sort(expected, axis=0))


def test_only_new_inputs_are_embedded(tmp_path) -> None:
    filled(tmp_path)
    model = Model()
    embeddings = EmbeddingCache(tmp_path, "frame", SETTINGS)
    embeddings.complete({"new/1": 9001, **INPUTS, "new/2": 9002}, model, 64)
    assert model.inputs == [9001, 9002]
    repeated = ["new/2", "new/1", "new/2"]
    assert np.array_equal(embeddings.rows(repeated), Model()([9002, 9001, 9002]))


def test_rows_of_several_lengths_are_padded_with_zeros(tmp_path) -> None:
    embeddings = EmbeddingCache(tmp_path, "query", SETTINGS)
    embeddings.complete({"q1": 1, "q3": 3, "q2": 2}, lambda some: np.ones((1, some[0])), 1)
    assert embeddings.rows(["q2", "q1"]).tolist() == [[1, 1, 0], [1, 0, 0]]


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.evaluation.embedders.test_cache import SETTINGS, INPUTS, Model
from dynapix.evaluation.embedders.cache import EmbeddingCache
class Dying(Model):
    def __call__(self, some):
        if len(self.inputs) >= 1300:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(some)
EmbeddingCache(Path(sys.argv[1]), "frame", SETTINGS).complete(INPUTS, Dying(), 64)
"""


def test_a_kill_costs_one_batch(tmp_path) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    root = Path(__file__).parents[3]
    ended = subprocess.run(command, cwd=root, capture_output=True, timeout=120)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    model = Model()
    embeddings = EmbeddingCache(tmp_path, "frame", SETTINGS)
    embeddings.complete(INPUTS, model, 64)
    assert model.inputs == list(INPUTS.values())[1344:]
    assert np.array_equal(embeddings.rows(list(INPUTS)), Model()(list(INPUTS.values())))


@pytest.mark.parametrize("damage", [lambda old: old[: len(old) // 2], lambda old: b"not a table"])
def test_a_damaged_file_is_named(tmp_path, damage) -> None:
    path = filled(tmp_path).path
    path.write_bytes(damage(path.read_bytes()))
    with raises_user_error("damaged-file", contains=path.name):
        EmbeddingCache(tmp_path, "frame", SETTINGS).complete({"new/1": 1}, Model(), 64)


def test_a_file_that_cannot_be_written_is_not_called_damaged(tmp_path) -> None:
    cache = filled(tmp_path)
    # SQLite then behaves as on a full disk.
    cache._db.execute("PRAGMA max_page_count = 1")
    with raises_user_error("unusable-cache", contains=(cache.path.name, "full")):
        cache.complete({f"new/{k}": k for k in range(2500)}, Model(), 64)


def test_a_non_finite_embedding_is_named_and_not_stored(tmp_path) -> None:
    queries = EmbeddingCache(tmp_path, "query", SETTINGS)
    with raises_user_error("non-finite-embedding", contains="query scene-003/3 and 1 more"):
        queries.complete(INPUTS, Model(bad=(3, 9)), 64)
    embeddings = EmbeddingCache(tmp_path, "frame", SETTINGS)
    with raises_user_error("non-finite-embedding", contains="frame scene-700/700"):
        embeddings.complete(INPUTS, Model(bad=(700,)), 64)
    model = Model()
    embeddings.complete(INPUTS, model, 64)
    assert model.inputs == list(INPUTS.values())[640:]


def test_two_processes_may_fill_one_file(tmp_path) -> None:
    first, second = (EmbeddingCache(tmp_path, "frame", SETTINGS) for _ in range(2))
    model = Model()

    def embed(some: list[int]) -> np.ndarray:
        second.complete({"scene-000/0": 0, "other/1": 1}, model, 64)
        return Model()(some)

    first.complete(dict(list(INPUTS.items())[:10]), embed, 64)
    assert model.inputs == [0, 1]
    assert np.array_equal(first.rows(["other/1", "scene-000/0"]), Model()([1, 0]))


@pytest.mark.parametrize("has_file", [False, True])
def test_a_store_that_cannot_be_written_keeps_its_files(tmp_path, monkeypatch, has_file) -> None:
    folder = tmp_path / "store" / "embeddings"
    if has_file:
        filled(folder)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    monkeypatch.setattr(os, "access", lambda *_: False)
    embeddings = EmbeddingCache(folder, "frame", SETTINGS)
    model = Model()
    embeddings.complete(INPUTS | {"new/1": 9001}, model, 64)
    assert model.inputs == ([9001] if has_file else [*INPUTS.values(), 9001])
    expected = Model()([*INPUTS.values(), 9001])
    assert np.array_equal(embeddings.rows([*INPUTS, "new/1"]), expected)
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after == before
    assert folder.exists() == has_file
