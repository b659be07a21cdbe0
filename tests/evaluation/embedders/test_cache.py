"""Embeddings on disk: read back byte for byte, gone on with after a kill, never taken damaged."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from conf.runs import lock_folder
from evaluation.embedders import cache
from evaluation.embedders.cache import EmbeddingCache
from tests.user_errors import raises_user_error

ABOUT = {"weights": "ab12", "image_size": 96}
THINGS = {f"scene-{k:03d}/{k}": k for k in range(2500)}


class Model:
    """Embeds a number, and counts what it was asked for."""

    def __init__(self, bad: tuple[int, ...] = ()) -> None:
        self.asked: list[int] = []
        self._bad = bad

    def __call__(self, some: list[int]) -> np.ndarray:
        self.asked += some
        rows = np.stack([np.random.default_rng(k).random(8, np.float32) for k in some])
        rows[[k in self._bad for k in some], 3] = np.nan
        return rows


def filled(folder: Path) -> EmbeddingCache:
    kept = EmbeddingCache(folder, "frame", ABOUT)
    kept.complete(THINGS, Model(), 64)
    return kept


def test_they_are_read_back_byte_for_byte_and_made_once(tmp_path) -> None:
    model = Model()
    expected = Model()(list(THINGS.values()))
    for _ in range(2):
        kept = EmbeddingCache(tmp_path, "frame", ABOUT)
        kept.complete(THINGS, model, 64)
        assert kept.rows(list(THINGS)).tobytes() == expected.tobytes()
        assert kept.width == 8
    assert model.asked == list(THINGS.values())


def test_parts_hold_each_asked_one_once(tmp_path) -> None:
    kept = filled(tmp_path)
    some = list(THINGS)[::-7]
    seen = {}
    for numbers, rows in kept.parts(some):
        assert len(rows) <= cache.PART_ROWS
        seen |= dict(zip(numbers.tolist(), rows, strict=True))
    assert sorted(seen) == list(range(len(some)))
    assert np.array_equal(np.stack([seen[k] for k in range(len(some))]), kept.rows(some))


def test_a_slow_model_loses_no_more_than_a_batch(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(cache, "PART_SECONDS", -1)
    model = Model(bad=(70,))
    kept = EmbeddingCache(tmp_path, "frame", ABOUT)
    with raises_user_error("non-finite-embedding", contains="scene-070/70"):
        kept.complete(THINGS, model, 16)
    again = Model()
    kept.complete(THINGS, again, 16)
    assert again.asked == list(range(64, 2500))


def test_only_what_is_new_is_embedded(tmp_path) -> None:
    filled(tmp_path)
    model = Model()
    more = {"new/1": 9001, **THINGS, "new/2": 9002}
    kept = EmbeddingCache(tmp_path, "frame", ABOUT)
    kept.complete(more, model, 64)
    assert model.asked == [9001, 9002]
    assert np.array_equal(kept.rows(["new/2", "new/1", "new/2"]), Model()([9002, 9001, 9002]))


@pytest.mark.parametrize("changed", [{"weights": "cd"}, {"image_size": 336}, {"precision": "fp32"}])
def test_what_was_made_by_another_is_not_taken(tmp_path, changed) -> None:
    filled(tmp_path)
    model = Model()
    EmbeddingCache(tmp_path, "frame", ABOUT | changed).complete({"scene-000/0": 0}, model, 64)
    assert model.asked == [0]


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path[:0] = {path!r}
from test_cache import ABOUT, THINGS, Model
from evaluation.embedders.cache import EmbeddingCache
class Dying(Model):
    def __call__(self, some):
        if len(self.asked) >= 1300:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__call__(some)
EmbeddingCache(Path(sys.argv[1]), "frame", ABOUT).complete(THINGS, Dying(), 64)
"""


def test_a_killed_embedding_goes_on(tmp_path) -> None:
    path = [str(Path(__file__).parent), str(Path(cache.__file__).parents[2])]
    command = [sys.executable, "-c", KILLED.format(path=path), str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONPATH": path[1]})
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    model = Model()
    kept = EmbeddingCache(tmp_path, "frame", ABOUT)
    (torn := kept.folder / "00002.npy").write_bytes(b"half a part")
    kept.complete(THINGS, model, 64)
    assert model.asked == list(THINGS.values())[2 * cache.PART_ROWS :]
    assert np.array_equal(kept.rows(list(THINGS)), Model()(list(THINGS.values())))
    assert torn.stat().st_size > 1000


@pytest.mark.parametrize(
    "damage",
    [
        lambda part: part.write_bytes(part.read_bytes()[:-40]),
        lambda part: part.write_bytes(part.read_bytes()[:-1] + b"\x01"),
        lambda part: part.unlink(),
        lambda part: part.with_suffix(".json").write_text('{"names": ['),
        lambda part: part.with_suffix(".json").write_text("[]"),
    ],
)
def test_a_damaged_part_is_told_and_made_again(tmp_path, damage, caplog) -> None:
    kept = filled(tmp_path)
    damage(kept.folder / "00001.npy")
    model = Model()
    with caplog.at_level(logging.WARNING):
        kept.complete(THINGS, model, 64)
    assert "00001.npy is damaged" in caplog.text
    assert sorted(model.asked) == list(range(cache.PART_ROWS, 2 * cache.PART_ROWS))
    assert np.array_equal(kept.rows(list(THINGS)), Model()(list(THINGS.values())))


def test_an_embedding_that_is_not_finite_is_named_and_not_kept(tmp_path) -> None:
    kept = EmbeddingCache(tmp_path, "frame", ABOUT)
    with raises_user_error("non-finite-embedding", contains="frame scene-700/700"):
        kept.complete(THINGS, Model(bad=(700,)), 64)
    queries = EmbeddingCache(tmp_path, "query", ABOUT)
    with raises_user_error("non-finite-embedding", contains="query scene-003/3 and 1 more"):
        queries.complete(THINGS, Model(bad=(3, 9)), 64)
    model = Model()
    kept.complete(THINGS, model, 64)
    assert model.asked == list(THINGS.values())[cache.PART_ROWS :]


def test_two_processes_do_not_fill_one_folder(tmp_path) -> None:
    kept = filled(tmp_path)
    with lock_folder(kept.folder, "unheard"):
        kept.complete(THINGS, Model(), 64)
        with raises_user_error("in-use"):
            kept.complete({"new/1": 1}, Model(), 64)
