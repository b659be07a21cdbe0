"""Embeddings on disk: read back byte for byte, resumed after a kill, and refused if damaged."""

from __future__ import annotations

import os
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


def opened(folder: Path) -> EmbeddingCache:
    return EmbeddingCache(folder, "frame", SETTINGS)


def filled(folder: Path) -> EmbeddingCache:
    embeddings = opened(folder)
    embeddings.complete(INPUTS, Model(), 64)
    return embeddings


def test_only_new_inputs_are_embedded_and_all_are_read_back_byte_for_byte(tmp_path) -> None:
    model, expected = Model(), Model()(list(INPUTS.values()))
    for _ in range(2):
        embeddings = opened(tmp_path)
        embeddings.complete(INPUTS, model, 64)
        assert embeddings.rows(list(INPUTS)).tobytes() == expected.tobytes()
    assert model.inputs == list(INPUTS.values())
    embeddings.complete({"new/1": 9001, **INPUTS, "new/2": 9002}, model, 64)
    assert model.inputs[len(INPUTS) :] == [9001, 9002]
    repeated = ["new/2", "new/1", "new/2"]
    assert np.array_equal(embeddings.rows(repeated), Model()([9002, 9001, 9002]))
    # The parts hold each requested embedding once.
    names = list(INPUTS)[::-7]
    parts = list(embeddings.parts(names))
    assert max(map(len, parts)) <= cache.PART_ROWS
    found, wanted = np.concatenate(parts), embeddings.rows(names)
    assert np.array_equal(np.sort(found, axis=0), np.sort(wanted, axis=0))


@pytest.mark.parametrize("damage", [lambda old: old[: len(old) // 2], lambda old: b"not a table"])
def test_a_damaged_file_is_named(tmp_path, damage) -> None:
    path = filled(tmp_path).path
    path.write_bytes(damage(path.read_bytes()))
    with raises_user_error("unusable-cache", contains=path.name):
        opened(tmp_path).complete({"new/1": 1}, Model(), 64)


def test_a_non_finite_embedding_is_named_and_not_stored(tmp_path) -> None:
    embeddings, model = opened(tmp_path), Model()
    with raises_user_error("non-finite-embedding", contains="frame scene-700/700 and 1 more"):
        embeddings.complete(INPUTS, Model(bad=(700, 703)), 64)
    embeddings.complete(INPUTS, model, 64)
    assert model.inputs == list(INPUTS.values())[640:]


def test_two_processes_may_fill_one_file(tmp_path) -> None:
    first, second, model = opened(tmp_path), opened(tmp_path), Model()

    def embed(some: list[int]) -> np.ndarray:
        second.complete({"scene-000/0": 0, "other/1": 1}, model, 64)
        return Model()(some)

    first.complete(dict(list(INPUTS.items())[:10]), embed, 64)
    assert model.inputs == [0, 1]
    assert np.array_equal(first.rows(["other/1", "scene-000/0"]), Model()([1, 0]))


def test_a_store_that_cannot_be_written_keeps_its_files(tmp_path, monkeypatch) -> None:
    kept, missing = filled(tmp_path / "kept").path, tmp_path / "missing"
    before = kept.read_bytes()
    monkeypatch.setattr(os, "access", lambda *_: False)
    expected = Model()([*INPUTS.values(), 9001])
    for folder, embedded in ((kept.parent, [9001]), (missing, [*INPUTS.values(), 9001])):
        model, embeddings = Model(), opened(folder)
        embeddings.complete(INPUTS | {"new/1": 9001}, model, 64)
        assert model.inputs == embedded
        assert np.array_equal(embeddings.rows([*INPUTS, "new/1"]), expected)
    assert [*kept.parent.iterdir()] == [kept]
    assert kept.read_bytes() == before
    assert not missing.exists()
