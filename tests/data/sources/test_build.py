"""Benchmarks are built from the releases of other simulators; invalid records are left out."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.schema import BenchmarkConfig, Quota, RetrievalTrackConfig, SelectionConfig
from dynapix.data.build import ensure_benchmark, ensure_items
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.parallel import Workers
from dynapix.data.sources.releases import READERS
from dynapix.data.sources.scenes import make_scenes
from tests.data.sources.clevrer_files import clevrer_annotation, write_clevrer_scene
from tests.data.sources.movi_a_files import movi_example, write_movi_folder
from tests.data.sources.pictures import picture
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def movi(tmp_path_factory) -> Path:
    """A release of twelve scenes, one of them damaged. Two objects touch in each, at five frames in
    turn."""
    folder = tmp_path_factory.mktemp("releases") / "movi_a"
    for k in range(12):
        example = movi_example([(12.0 + k % 5, 0, 1, 1.0, 0.0)])
        example["image_positions"][..., 0] = 0.05 + 0.02 * k + np.arange(24) * 0.03
        example["image_positions"][..., 1] = 0.5
        write_movi_folder(folder / f"{k:05d}", example)
    (folder / "00007" / "events.json").write_text('{"collisions": [')
    return folder


def config(folder: Path | None, **changes: object) -> BenchmarkConfig:
    settings = {
        "name": "movi",
        "simulator": "movi_a",
        "folder": folder and str(folder),
        "test_share": 1.0,
        "selection": SelectionConfig(
            event={"contact": Quota(0, 6)}, time={"in_1s": Quota(0, 6)}, min_displacement=4.0
        ),
        "retrieval": RetrievalTrackConfig(database=0, source=0),
    }
    return BenchmarkConfig(**{**settings, **changes})


def test_a_release_becomes_a_suite_with_its_own_frames(movi, tmp_path, caplog) -> None:
    caplog.set_level("INFO")
    store = ensure_benchmark(config(movi), tmp_path, workers=2)
    assert store.manifest["counts"]["bad records left out"] == 1
    assert "00007" in caplog.text
    items = store.selection("test")
    assert {i.family for i in items} == {"event", "time"}
    assert {i.suite for i in items} == {"movi_a"}
    assert store.selection("train") == store.retrieval() == store.database() == []
    frames = FrameReader(store)
    for candidate in items[0].candidates:
        expected = np.asarray(picture(candidate.frame, (256, 256)))
        np.testing.assert_array_equal(frames.array(candidate.scene_id, candidate.frame), expected)


def test_an_invalid_record_stops_a_strict_build(movi, tmp_path) -> None:
    with raises_user_error("invalid-record", contains=("00007", "strict=false")):
        ensure_items(config(movi), tmp_path, Workers(1), strict=True)
    assert not (tmp_path / "movi").exists()


def test_displacements_below_a_pixel_of_a_release_are_refused(movi, tmp_path) -> None:
    """Its frames are 256 px wide and high, so that a pixel is 1.31 px of 336."""
    selection = SelectionConfig(time={"in_1s": Quota(0, 6)}, min_displacement=1.3)
    with raises_user_error("invalid-setting", contains=("1.31", "256 x 256")):
        ensure_items(config(movi, selection=selection), tmp_path, Workers(1))


def test_scaled_velocities_are_logged_once(tmp_path, caplog) -> None:
    release = tmp_path / "release"
    for k in range(4):
        example = movi_example()
        write_movi_folder(release / f"{k:05d}", example | {"velocities": 2 * example["velocities"]})
    make_scenes(config(release), tmp_path / "store", Workers(2), True)
    (line,) = [r.getMessage() for r in caplog.records if "velocities" in r.getMessage()]
    assert "4 scenes of 4 were multiplied by 0.5," in line


def test_a_mended_record_is_read_by_the_next_build(movi, tmp_path) -> None:
    """Also if the file that was mended is not the one whose size and time identify the record."""
    release = shutil.copytree(movi, tmp_path / "release" / "movi_a")
    events = release / "00007" / "events.json"
    for damage in ("not JSON", "not a file"):
        if damage == "not a file":
            events.unlink()
            events.mkdir()
        scenes, counts = make_scenes(config(release), tmp_path / "store", Workers(1), False)
        assert counts == {"bad records left out": 1}, damage
        assert len(scenes["test"]) == 11
    events.rmdir()
    shutil.copy(release / "00006" / "events.json", events)
    scenes, counts = make_scenes(config(release), tmp_path / "store", Workers(1), False)
    assert counts == {"bad records left out": 0}
    assert len(scenes["test"]) == 12


def test_a_record_that_may_not_be_read_stops_the_build(movi, tmp_path, monkeypatch) -> None:
    """Otherwise the benchmark would be smaller without notice."""

    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(READERS["movi_a"], "read_scene", refuse)
    with raises_user_error("unreadable-file", contains="0000"):
        make_scenes(config(movi), tmp_path / "store", Workers(1), False)


def test_a_release_without_a_valid_record_names_their_number(movi, tmp_path) -> None:
    broken = tmp_path / "release" / "movi_a"
    shutil.copytree(movi, broken)
    for events in broken.glob("*/events.json"):
        events.write_text("{")
    with raises_user_error("empty-benchmark", contains="12 bad records left out"):
        ensure_items(config(broken), tmp_path / "store", Workers(1))


def test_queries_of_a_release_are_refused(movi) -> None:
    queries = replace(config(movi).retrieval, builders={"1": Quota(1, 1)})
    [problem] = config(movi, retrieval=queries).find_problems("benchmark.")
    assert "benchmark.retrieval.builders" in problem


def test_a_release_may_move_after_the_build(movi, tmp_path) -> None:
    release = shutil.copytree(movi, tmp_path / "release")
    built = ensure_items(config(release), tmp_path, Workers(1))
    moved = release.rename(tmp_path / "moved")
    store = ensure_items(config(moved), tmp_path, Workers(1))
    assert store.identity == built.identity
    candidate = store.selection("test")[0].candidates[0]
    frame = FrameReader(store).array(candidate.scene_id, candidate.frame)
    np.testing.assert_array_equal(frame, np.asarray(picture(candidate.frame, (256, 256))))


def test_a_release_without_its_folder_is_refused(tmp_path) -> None:
    with raises_user_error("missing-setting", contains="benchmark.folder=FOLDER"):
        ensure_items(config(None), tmp_path, Workers(1))
    with raises_user_error("missing-folder", contains="nowhere"):
        ensure_items(config(tmp_path / "nowhere"), tmp_path, Workers(1))


def test_clevrers_scenes_have_the_items_of_dynapix(tmp_path) -> None:
    for k in range(8):
        annotation = clevrer_annotation(k)
        for moment in annotation["motion_trajectory"]:
            for state in moment["objects"]:
                state["location"][0] -= 0.2 * k
        write_clevrer_scene(tmp_path / "release", annotation, k)
    few = Quota(train=2, test=1)
    cfg = BenchmarkConfig(
        name="clevrer",
        simulator="clevrer",
        folder=str(tmp_path / "release"),
        selection=SelectionConfig(time={"in_1s": few}),
        retrieval=RetrievalTrackConfig(builders={"2": few}, database=8, source=20),
    )
    store = ensure_benchmark(cfg, tmp_path, workers=1)
    assert {i.suite for i in store.selection()} == {"dynapix"}
    assert {q.split for q in store.retrieval()} == {"train", "test"}
    assert len(store.scene_ids("train") + store.scene_ids("test")) == 8
