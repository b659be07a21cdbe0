"""Laws of all readers of releases: a scene occurs once, and its record makes sense."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dynapix.data.parallel import Workers
from dynapix.data.records import original_scene_id
from dynapix.data.sources import clevrer, movi_a, physion, releases, tracks
from dynapix.data.sources.releases import read_release
from dynapix.data.sources.validation import scene_id
from tests.data.sources.clevrer_files import clevrer_annotation, write_clevrer_scene
from tests.data.sources.movi_a_files import (
    movi_example,
    movi_features,
    write_movi_folder,
    write_tfrecord,
)
from tests.data.sources.physion_files import physion_trial, write_physion
from tests.data.sources.test_build import config
from tests.data.sources.tracks_files import write_tracked_video
from tests.user_errors import raises_user_error


def write_clevrer(folder: Path) -> Path:
    return write_clevrer_scene(folder, clevrer_annotation())[0]


def write_shard(folder: Path) -> Path:
    features = [movi_features(movi_example())]
    return write_tfrecord(folder / "movi_a-train.tfrecord-00000-of-00001", features)


def write_trial(folder: Path) -> Path:
    return write_physion(folder / "Collide" / "0000.hdf5", physion_trial())


def write_video(folder: Path) -> Path:
    return write_tracked_video(folder, "street", 30).with_suffix(".mp4")


SCENES = {
    "clevrer": (clevrer, write_clevrer),
    "movi_a": (movi_a, lambda folder: write_movi_folder(folder / "00000", movi_example())),
    "movi_a shard": (movi_a, write_shard),
    "physion": (physion, write_trial),
    "tracks": (tracks, write_video),
}
"""For each layout, its reader, and a function that writes a scene and returns its main file."""


def test_files_that_a_user_writes_may_begin_with_a_byte_order_mark(tmp_path) -> None:
    for layout, names in {
        "clevrer": ["annotation_00000.json"],
        "movi_a": ["metadata.json", "events.json"],
        "tracks": ["tracks.yaml", "street.txt"],
    }.items():
        reader, write = SCENES[layout]
        folder = tmp_path / layout
        write(folder)
        [path] = reader.list_scenes(folder)
        before = reader.read_scene(path, folder, "test")
        for name in names:
            [file] = folder.rglob(name)
            file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
        [path] = reader.list_scenes(folder)
        after = reader.read_scene(path, folder, "test")
        assert (after.objects, after.collisions) == (before.objects, before.collisions)
        assert after.positions.tobytes() == before.positions.tobytes()


@pytest.mark.parametrize(
    "change",
    [
        {"video_filename": "video_00000-01000/video_00000.mp4"},
        {"video_filename": "../video_00000.mp4"},
        {"video_filename": ""},
        {"video_filename": "/etc/passwd"},
        {"video_filename": "video_00000.mp4\n"},
        {"collision": [{"object_ids": [0, 0], "frame_id": 20}]},
        {"collision": [{"object_ids": [0, 2], "frame_id": 20}]},
        {"collision": [{"object_ids": [0, 1], "frame_id": 128}]},
        {"object_property": [clevrer_annotation()["object_property"][0]] * 2},
    ],
)
def test_a_record_without_sense_is_left_out(tmp_path, change, caplog) -> None:
    path, _ = write_clevrer_scene(tmp_path / "release", clevrer_annotation() | change)
    cfg = replace(config(tmp_path / "release"), simulator="clevrer")
    splits = {"train": [], "test": [path]}
    scenes, counts = read_release(cfg, splits, tmp_path / "built", Workers(1), strict=False)
    assert (scenes["test"], counts) == ([], {"bad records left out": 1})
    assert f"left out: {path}" in caplog.text


def test_objects_with_one_id_and_images_without_a_size_are_refused(tmp_path) -> None:
    path = write_trial(tmp_path)
    import h5py

    with h5py.File(path, "a") as file:
        file["static/object_ids"][...] = file["static/object_ids"][0]
    with raises_user_error("invalid-record", contains="id"):
        physion.read_scene(path, tmp_path, "test")
    path = write_movi_folder(tmp_path / "00000", movi_example())
    metadata = json.loads(path.read_text())
    metadata["metadata"]["resolution"] = [0, 256]
    path.write_text(json.dumps(metadata))
    with raises_user_error("invalid-record", contains="resolution"):
        movi_a.read_scene(path, tmp_path, "test")


def test_contacts_of_an_object_with_itself_are_no_contacts(tmp_path) -> None:
    example = movi_example([(12.0, 0, 0, 0.0, 1.0), (14.0, 0, 1, 1.0, 0.0), (15.0, 0, 9, 1.0, 0.0)])
    path = write_movi_folder(tmp_path / "00000", example)
    assert [c.objects for c in movi_a.read_scene(path, tmp_path, "test").collisions] == [(0, 1)]


@pytest.mark.parametrize("name", ["street-without-3", "a-alt-b", "x-without-alt-y", "a/b c"])
def test_a_name_does_not_make_a_scene_of_another_one(name) -> None:
    own = scene_id(name, "000128")
    assert original_scene_id(own) == own
    assert Path(own).name == own


def test_an_error_of_a_library_leaves_its_record_out(tmp_path, monkeypatch, caplog) -> None:
    path = write_clevrer(tmp_path / "release")

    def read_scene(*_: object) -> None:
        raise KeyError("what no reader expects")

    monkeypatch.setattr(releases.READERS["clevrer"], "read_scene", read_scene)
    cfg = replace(config(tmp_path / "release"), simulator="clevrer")
    splits = {"train": [], "test": [path]}
    _, counts = read_release(cfg, splits, tmp_path / "built", Workers(1), strict=False)
    assert counts == {"bad records left out": 1}
    assert f"{path}: KeyError: 'what no reader expects'" in caplog.text
