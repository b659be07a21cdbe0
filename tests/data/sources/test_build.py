"""Benchmarks are built from the releases of other simulators; invalid records are left out."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.schema import BenchmarkConfig, Quota, RetrievalTrackConfig, SelectionConfig
from dynapix.data.build import ensure_benchmark, ensure_items
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.parallel import Workers
from dynapix.data.records import original_scene_id
from dynapix.data.sources import clevrer, movi_a, tracks
from dynapix.data.sources.releases import READERS
from dynapix.data.sources.scenes import make_scenes
from dynapix.data.sources.validation import scene_id
from tests.data.sources.clevrer_files import clevrer_annotation, write_clevrer_scene
from tests.data.sources.movi_a_files import movi_example, write_movi_folder
from tests.data.sources.pictures import picture
from tests.data.sources.tracks_files import write_tracked_video
from tests.user_errors import raises_user_error


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


@pytest.mark.slow
def test_a_release_becomes_a_suite_with_its_own_frames(movi, tmp_path, caplog) -> None:
    """It may move after the build."""
    caplog.set_level("INFO")
    release = shutil.copytree(movi, tmp_path / "release")
    built = ensure_items(config(release), tmp_path, Workers(2))
    assert built.manifest["counts"]["bad records left out"] == 1
    assert "00007" in caplog.text
    store = ensure_items(config(release.rename(tmp_path / "moved")), tmp_path, Workers(1))
    assert store.identity == built.identity
    items = store.selection("test")
    assert {i.family for i in items} == {"event", "time"}
    assert {i.suite for i in items} == {"movi_a"}
    assert store.selection("train") == store.retrieval() == store.database() == []
    frames = FrameReader(store)
    for candidate in items[0].candidates:
        expected = np.asarray(picture(candidate.frame, (256, 256)))
        np.testing.assert_array_equal(frames.array(candidate.scene_id, candidate.frame), expected)


@pytest.mark.slow
def test_what_cannot_be_built_is_refused(movi, tmp_path) -> None:
    with raises_user_error("invalid-record", contains=("00007", "strict=false")):
        ensure_items(config(movi), tmp_path, Workers(1), strict=True)
    # Frames of the release are 256 px wide and high, so that a pixel is 1.31 px of 336.
    selection = SelectionConfig(time={"in_1s": Quota(0, 6)}, min_displacement=1.3)
    with raises_user_error("invalid-setting", contains=("1.31", "256 x 256")):
        ensure_items(config(movi, selection=selection), tmp_path, Workers(1))
    with raises_user_error("missing-setting", contains="benchmark.folder=FOLDER"):
        ensure_items(config(None), tmp_path, Workers(1))
    with raises_user_error("missing-folder", contains="nowhere"):
        ensure_items(config(tmp_path / "nowhere"), tmp_path, Workers(1))
    broken = shutil.copytree(movi, tmp_path / "broken")
    for events in broken.glob("*/events.json"):
        events.write_text("{")
    with raises_user_error("empty-benchmark", contains="12 bad records left out"):
        ensure_items(config(broken), tmp_path, Workers(1))
    assert not (tmp_path / "movi").exists()
    queries = RetrievalTrackConfig(builders={"1": Quota(1, 1)}, database=0, source=0)
    [problem] = config(movi, retrieval=queries).find_problems("benchmark.")
    assert "benchmark.retrieval.builders" in problem


def test_scaled_velocities_are_logged_once(tmp_path, caplog) -> None:
    release = tmp_path / "release"
    for k in range(2):
        example = movi_example()
        write_movi_folder(release / f"{k:05d}", example | {"velocities": 2 * example["velocities"]})
    make_scenes(config(release), tmp_path / "store", Workers(1), True)
    (line,) = [r.getMessage() for r in caplog.records if "velocities" in r.getMessage()]
    assert "2 scenes of 2 were multiplied by 0.5," in line


def test_a_mended_record_is_read_by_the_next_build(tmp_path) -> None:
    """Also if the file that was mended is not the one whose size and time identify the record."""
    release = tmp_path / "release"
    for k in range(2):
        write_movi_folder(release / f"{k:05d}", movi_example())
    events = release / "00001" / "events.json"
    whole = events.read_text()
    for content, left_out in (("not JSON", 1), (whole, 0)):
        events.write_text(content)
        scenes, counts = make_scenes(config(release), tmp_path / "store", Workers(1), False)
        assert counts == {"bad records left out": left_out}
        assert len(scenes["test"]) == 2 - left_out


def test_an_error_of_a_library_leaves_its_record_out(tmp_path, monkeypatch, caplog) -> None:
    path = write_movi_folder(tmp_path / "release" / "00000", movi_example())

    def read_scene(*_: object) -> None:
        raise KeyError("what no reader expects")

    monkeypatch.setattr(READERS["movi_a"], "read_scene", read_scene)
    _, counts = make_scenes(config(tmp_path / "release"), tmp_path / "built", Workers(1), False)
    assert counts == {"bad records left out": 1}
    assert f"{path}: KeyError: 'what no reader expects'" in caplog.text


@pytest.mark.slow
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


def test_files_that_a_user_writes_may_begin_with_a_byte_order_mark(tmp_path) -> None:
    write_clevrer_scene(tmp_path / "clevrer", clevrer_annotation())
    write_movi_folder(tmp_path / "movi_a" / "00000", movi_example())
    write_tracked_video(tmp_path / "tracks", "street", 30)
    for reader, folder, names in (
        (clevrer, tmp_path / "clevrer", ["annotation_00000.json"]),
        (movi_a, tmp_path / "movi_a", ["metadata.json", "events.json"]),
        (tracks, tmp_path / "tracks", ["tracks.yaml", "street.txt"]),
    ):
        [path] = reader.list_scenes(folder)
        before = reader.read_scene(path, folder, "test")
        for name in names:
            [file] = folder.rglob(name)
            file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
        [path] = reader.list_scenes(folder)
        after = reader.read_scene(path, folder, "test")
        assert (after.objects, after.collisions) == (before.objects, before.collisions)
        assert after.positions.tobytes() == before.positions.tobytes()


def test_a_name_does_not_make_a_scene_of_another_one() -> None:
    for name in ("street-without-3", "a-alt-b", "x-without-alt-y", "a/b c"):
        own = scene_id(name, "000128")
        assert original_scene_id(own) == own
        assert Path(own).name == own
