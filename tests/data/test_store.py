"""Builds are deterministic and resume after a kill; opening a store detects damaged files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import psutil
import pytest

from dynapix.conf.schema import BenchmarkConfig, Quota, RetrievalTrackConfig, SelectionConfig
from dynapix.conf.schema.world import ObjectsConfig, WorldConfig
from dynapix.data import store as stores
from dynapix.data.build import build, ensure_benchmark, ensure_items, lock_partial_build
from dynapix.data.parallel import Workers
from dynapix.data.sources.scenes import split_scenes
from dynapix.data.store import CHECKED, MANIFEST, hash_file, hash_files, open_store
from tests.user_errors import raises_user_error
from tests.waiting import wait_until


def small(**changes: object) -> BenchmarkConfig:
    """A config with six scenes and a few items, which builds quickly."""
    few = Quota(train=2, test=1)
    settings = {
        "name": "small",
        "scenes": 6,
        "width": 96,
        "height": 64,
        "selection": SelectionConfig(time={"in_1s": few}),
        "retrieval": RetrievalTrackConfig(builders={"2": few}, hard_negatives=1, database=6),
    }
    return BenchmarkConfig(**{**settings, **changes})


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    return ensure_benchmark(small(), tmp_path_factory.mktemp("built"), workers=1).folder


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    subprocess.run(["cp", "-r", built, tmp_path / "small"], check=True)
    return tmp_path / "small"


def file_hashes(folder: Path) -> dict[str, str]:
    return hash_files(folder, json.loads((folder / MANIFEST).read_text())["files"])


def content_hashes(folder: Path) -> dict[str, str]:
    """Hashes of all files of a store by name, and the text of its manifest."""
    frames = {p.name: hash_file(p) for p in (folder / "frames").glob("*.zip")}
    return {**file_hashes(folder), **frames, MANIFEST: (folder / MANIFEST).read_text()}


@pytest.mark.slow
def test_builds_are_byte_identical_with_any_number_of_workers(built, tmp_path) -> None:
    ensure_benchmark(small(), tmp_path, workers=2)
    assert content_hashes(tmp_path / "small") == content_hashes(built)


@pytest.mark.slow
@pytest.mark.parametrize("part", [".small.partial/scenes", "small/frames"])
def test_killed_build_resumes_to_identical_bytes(built, tmp_path, part) -> None:
    code = (
        "from pathlib import Path\n"
        "from tests.data.test_store import *\n"
        f"if __name__ == '__main__': ensure_benchmark(small(), Path({str(tmp_path)!r}), workers=2)"
    )
    script = tmp_path / "run.py"
    script.write_text(code)
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    child = subprocess.Popen([sys.executable, script], env=env)
    parts = tmp_path / part
    wait_until(lambda: child.poll() is not None or len(list(parts.glob("[!.]*"))) >= 2)
    workers = psutil.Process(child.pid).children()
    child.kill()
    child.wait()
    assert workers
    assert not psutil.wait_procs(workers, timeout=30)[1]
    first = {p.name: p.stat().st_mtime_ns for p in parts.glob("[!.]*")}
    ensure_benchmark(small(), tmp_path, workers=1)
    assert content_hashes(tmp_path / "small") == content_hashes(built)
    kept = tmp_path / "small" / parts.name
    assert all((kept / name).stat().st_mtime_ns == modified for name, modified in first.items())


KILLED = {
    "more scenes": {"scenes": 12},
    "fewer test scenes": {"scenes": 12, "test_scenes": 1},
    "another quota": {"selection": SelectionConfig(time={"in_1s": Quota(train=1, test=1)})},
    "another displacement": {
        "selection": SelectionConfig(time={"in_1s": Quota(2, 1)}, min_displacement=40.0)
    },
    "alternative futures": {"distractors": "balanced"},
    "another suite": {"recipe": "physion", "retrieval": RetrievalTrackConfig()},
    "counterfactual scenes": {
        "retrieval": RetrievalTrackConfig(counterfactual=Quota(1, 1), counterfactual_source=4)
    },
}
"""Settings of a build that is killed, as changes of `small`."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("killed", "stage"),
    [
        *((changes, "count_records") for changes in KILLED.values()),
        (KILLED["fewer test scenes"], "make_items_and_queries"),
        (KILLED["alternative futures"], "make_databases"),
    ],
    ids=[*KILLED, "before the items", "before the databases"],
)
def test_build_resumed_at_other_settings_equals_a_fresh_one_or_is_refused(
    built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: dict, stage: str
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"dynapix.data.build.{stage}", stop)
        with pytest.raises(KeyboardInterrupt):
            build(small(**killed), tmp_path / "small", Workers(1))
    if killed == KILLED["counterfactual scenes"]:
        with raises_user_error("other-settings"):
            build(small(), tmp_path / "small", Workers(1))
        return
    build(small(), tmp_path / "small", Workers(1))
    made = {p.relative_to(tmp_path / "small").as_posix() for p in (tmp_path / "small").rglob("*.*")}
    expected = {*file_hashes(built), MANIFEST}
    assert made == expected
    assert file_hashes(tmp_path / "small") == file_hashes(built)
    assert (tmp_path / "small" / MANIFEST).read_text() == (built / MANIFEST).read_text()


@pytest.mark.slow
def test_partial_build_with_other_scenes_is_kept(tmp_path) -> None:
    nothing = {"selection": SelectionConfig(), "retrieval": RetrievalTrackConfig()}
    with raises_user_error("empty-benchmark"):
        build(small(**nothing), tmp_path / "small", Workers(1))
    assert not (tmp_path / "small").exists()
    fewer = WorldConfig(objects=ObjectsConfig(max_count=5))
    with raises_user_error("other-settings", contains="world.objects.max_count was 6"):
        build(small(world=fewer), tmp_path / "small", Workers(1))
    scenes = tmp_path / ".small.partial" / "scenes"
    first = {p.name: p.stat().st_mtime_ns for p in scenes.iterdir()}
    assert len(first) == 6
    # A build of other items resumes with the same scenes.
    build(small(), tmp_path / "small", Workers(1))
    kept = tmp_path / "small" / "scenes"
    assert {p.name: p.stat().st_mtime_ns for p in kept.iterdir()} == first


@pytest.mark.slow
def test_concurrent_builds_make_one_store(tmp_path, built, caplog) -> None:
    """While one builder holds the lock, others wait for it, as jobs of a sweep do."""
    caplog.set_level("INFO")
    stores = []
    others = [
        threading.Thread(
            target=lambda: stores.append(ensure_items(small(), tmp_path, Workers(1))), daemon=True
        )
        for _ in range(2)
    ]
    with lock_partial_build(small(), tmp_path / "small"):
        for other in others:
            other.start()
        wait_until(lambda: caplog.text.count("is being built by another process; waiting") == 2)
    for other in others:
        other.join(timeout=300)
    assert len(stores) == 2
    assert file_hashes(tmp_path / "small") == file_hashes(built)
    assert sorted(os.listdir(tmp_path)) == [".small.lock", "small"]


@pytest.mark.parametrize("scenes", [10, 12, 100])
def test_split_of_a_scene_is_independent_of_the_number_of_scenes(scenes) -> None:
    names = [f"s0-{k:06d}" for k in range(500)]
    some, more = split_scenes(small(), names[:scenes]), split_scenes(small(), names)
    for split in ("train", "test"):
        assert set(some[split]) <= set(more[split])
        assert sorted(some[split]) == some[split]
    assert len(more["test"]) == 100


@pytest.mark.parametrize("share", [0.01, 0.2, 0.99])
@pytest.mark.parametrize("seed", range(5))
def test_no_split_is_empty(share: float, seed: int) -> None:
    for count in range(2, 8):
        splits = split_scenes(small(test_share=share, seed=seed), names := [*range(count)])
        assert splits["train"]
        assert splits["test"]
        assert sorted(splits["train"] + splits["test"]) == names
    with raises_user_error("empty-split", contains=f"benchmark.test_share={share}"):
        split_scenes(small(test_share=share, seed=seed), ["a"])


@pytest.mark.parametrize("part", ["selection.parquet", "scenes"])
def test_damaged_or_missing_file_is_named(copy, part) -> None:
    path = copy / part
    path = next(path.iterdir()) if path.is_dir() else path
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with raises_user_error("damaged-file", contains=path.name):
        open_store(copy)
    path.unlink()
    with raises_user_error("missing-file", contains=path.name):
        open_store(copy)


def test_only_files_that_changed_since_the_last_check_are_hashed(copy, monkeypatch) -> None:
    (copy / CHECKED).unlink(missing_ok=True)
    hashed: list[str] = []

    def record(path: Path) -> str:
        hashed.append(path.name)
        return hash_file(path)

    monkeypatch.setattr(stores, "hash_file", record)
    files = built_hashes(copy)
    open_store(copy)
    assert len(hashed) == len(files)
    hashed.clear()
    open_store(copy)
    assert not hashed
    table = copy / "selection.parquet"
    os.utime(table, ns=(0, 0))
    open_store(copy)
    assert hashed == [table.name]
    # Other bytes with the same size and time are found only if all files are hashed.
    table.write_bytes(b"x" * table.stat().st_size)
    os.utime(table, ns=(0, 0))
    open_store(copy)
    with raises_user_error("damaged-file", contains=table.name):
        open_store(copy, verify=True)


@pytest.mark.parametrize("content", ["", "[1]", "{", '{"selection.parquet": 3}'])
def test_damaged_record_of_the_last_check_is_replaced(copy, content) -> None:
    (copy / CHECKED).write_text(content)
    open_store(copy)
    assert json.loads((copy / CHECKED).read_text()).keys() == built_hashes(copy).keys()


def built_hashes(folder: Path) -> dict[str, str]:
    return json.loads((folder / MANIFEST).read_text())["files"]


VERSION_KEYS = {name: f'"{name}": "'.encode() for name in ("generator", "renderer", "builders")}


@pytest.mark.parametrize(
    ("damage", "code", "name"),
    [
        (lambda text: text[:100], "damaged-file", MANIFEST),
        (lambda text: b"[]", "damaged-file", MANIFEST),
        (lambda text: b"\xff" + text, "damaged-file", MANIFEST),
        (lambda text: text.replace(b'"scenes": 6', b'"scenes": 7'), "damaged-file", MANIFEST),
        # The version is the first key of this name; the settings, which follow, have it too.
        *(
            (lambda text, key=key: text.replace(key, key + b"0", 1), "different-version", name)
            for name, key in VERSION_KEYS.items()
        ),
    ],
)
def test_damaged_or_old_manifest_is_refused(copy, damage, code, name) -> None:
    text = (copy / MANIFEST).read_bytes()
    (copy / MANIFEST).write_bytes(damage(text))
    with raises_user_error(code, contains=name):
        open_store(copy)


def test_different_settings_are_named(copy) -> None:
    cfg = small(selection=SelectionConfig(time={"in_1s": Quota(train=3, test=1)}))
    key = "benchmark.selection.time.in_1s.train was 2"
    with raises_user_error("other-settings", contains=key):
        ensure_benchmark(cfg, copy.parent, 1)


def test_unknown_cell_is_refused(tmp_path) -> None:
    unknown = SelectionConfig(event={"future_offset_gap11": Quota(train=1)})
    names = ("selection.event.future_offset_gap11", "future_offset_gap10?")
    with raises_user_error("unknown-option", contains=names):
        build(small(selection=unknown), tmp_path / "small", Workers(1))
    assert not list(tmp_path.iterdir())
