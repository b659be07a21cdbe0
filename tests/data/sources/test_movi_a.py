"""Both formats of MoVi-A give the same scene, contacts become collisions and landings, and invalid
files are refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dynapix.data.records import Collision, Landing, Scene
from dynapix.data.sim.shapes import rotation_matrix
from dynapix.data.sources import movi_a, tfrecord
from tests.data.sources.movi_a_files import (
    movi_example,
    movi_features,
    write_movi_folder,
    write_tfrecord,
)
from tests.user_errors import raises_user_error

SHARD = "movi_a-train.tfrecord-00003-of-00512"


def from_folder(folder: Path, contacts: list) -> Scene:
    path = write_movi_folder(folder / "00012", movi_example(contacts))
    return movi_a.read_scene(path, folder, "test")


def from_record(folder: Path, contacts: list) -> Scene:
    write_tfrecord(folder / SHARD, [movi_features(movi_example(contacts))])
    (path,) = movi_a.list_scenes(folder)
    return movi_a.read_scene(path, folder, "test")


@pytest.fixture(params=[from_folder, from_record])
def read_format(request: pytest.FixtureRequest) -> Callable[[Path, list], Scene]:
    return request.param


def test_a_scene_has_the_published_values(read_format, tmp_path: Path) -> None:
    scene = read_format(tmp_path, [])
    assert scene.scene_id in {"movi_a-00012", "movi_a-train-00003-00000"}
    assert (scene.frames, scene.fps, scene.image_size) == (24, 12, (256, 256))
    assert [o.noun_phrase for o in scene.objects] == [
        "large red metal cube", "small cyan rubber sphere", "small red metal cylinder",
    ]  # fmt: skip
    # Frame 0 of the video shows the scene 1/12 s after the simulation begins.
    fallen = 5 - 9.81 / 2 * (np.arange(1, 25) / 12) ** 2
    np.testing.assert_allclose(scene.positions[:, 0, 2], fallen, rtol=1e-5)
    np.testing.assert_allclose(scene.positions[:, 1, 0], 1 + np.arange(1, 25) / 12, rtol=1e-5)
    turn = [[np.cos(1), -np.sin(1), 0], [np.sin(1), np.cos(1), 0], [0, 0, 1]]
    np.testing.assert_allclose(rotation_matrix(scene.quaternions[11, 0]), turn, atol=1e-6)
    assert scene.object_radii == pytest.approx((0.7, 0.3, 0.5), abs=1e-5)
    np.testing.assert_allclose(scene.image_positions[:, 0, 0], 128, rtol=1e-6)
    assert scene.image_positions[11, 1, 0] == pytest.approx(256 * (0.5 + 2 / 20))
    assert np.isnan(scene.visible_fraction).all()
    assert scene.in_view.all(axis=0).tolist() == [True, True, False]
    # The images are not blended with their transparency.
    images = movi_a.load_images(scene, tmp_path, [17, 2])
    assert {f: image.getpixel((9, 9))[0] for f, image in images.items()} == {2: 62, 17: 77}


def test_contact_points_become_one_contact_of_a_pair(read_format, tmp_path: Path) -> None:
    """Contacts of an object with itself and with no object are no contacts."""
    many = [(9.1 + 0.05 * k, *pair, 0.5, 0.0) for k in range(200) for pair in ((1, 0), (0, 1))]
    others = [(12.0, 0, 0, 0.0, 1.0), (15.0, 0, 9, 1.0, 0.0)]
    assert read_format(tmp_path, many + others).collisions == (Collision(9, (0, 1), 19),)


@pytest.mark.parametrize(
    ("time", "by_folder", "by_record"), [(9.0, 8, 9), (9.05, 9, 9), (0.4, 0, 0)]
)
def test_a_collision_is_the_first_frame_not_before_its_contact(
    tmp_path: Path, time, by_folder, by_record
) -> None:
    """Times of contacts count the simulation's frames, and frame i of the video shows the
    simulation's frame i + 1. TFRecords truncate the times, so that only the next frame is certainly
    not before the contact."""
    contact = [(time, 0, 1, 0.5, 0.0)]
    for read, frame in ((from_folder, by_folder), (from_record, by_record)):
        (collision,) = read(tmp_path / read.__name__, contact).collisions
        assert collision == Collision(frame, (0, 1), frame)


def test_contacts_with_the_floor_are_landings_not_collisions(read_format, tmp_path: Path) -> None:
    """Instance -1 is the floor or an object that is never visible. Contacts with such an object are
    above the floor or have a nearly horizontal normal."""
    contacts = [
        (12.3, 0, -1, 0.001, -1.0),
        (12.35, 0, -1, 0.001, -1.0),
        (16.2, -1, 1, 0.0, 0.98),
        (5.0, -1, 2, 0.6, 1.0),
        (6.0, 2, -1, 0.0, 0.1),
        (20.0, -1, -1, 0.0, 1.0),
    ]
    scene = read_format(tmp_path / "falls", contacts)
    assert scene.collisions == ()
    assert scene.landings == (Landing(12, 0), Landing(16, 1))
    # An object that touches the floor in the first frame has no landing, even after a later fall,
    # and what follows the last frame has no event.
    floor = [(0.5, 2), (9.5, 2), (9.5, 1), (24.3, 0)]
    contacts = [(24.05, 0, 1, 0.5, 0.0), *((frame, k, -1, 0.0, 1.0) for frame, k in floor)]
    scene = read_format(tmp_path / "edges", contacts)
    assert (scene.collisions, scene.landings) == ((), (Landing(9, 1),))


def test_scenes_of_both_formats_are_listed_in_order(tmp_path: Path) -> None:
    for name in ("00012", "00003"):
        write_movi_folder(tmp_path / "raw" / name, movi_example())
    features = movi_features(movi_example())
    write_tfrecord(tmp_path / "tfds" / SHARD, [features, features])
    for own in ("metadata.json", "dataset_info.json", "features.json"):
        (tmp_path / "tfds" / own).write_text("{}")
    paths = movi_a.list_scenes(tmp_path)
    assert [movi_a.read_scene(p, tmp_path, "test").scene_id for p in paths] == [
        "movi_a-raw-00003", "movi_a-raw-00012",
        "movi_a-train-00003-00000", "movi_a-train-00003-00001",
    ]  # fmt: skip


FOLDER_DEFECTS: dict[str, tuple[str, Callable[[dict], object], str]] = {
    "an array of 23 frames": (
        "metadata.json", lambda r: r["instances"][0]["positions"].pop(), "instances.0.positions"
    ),
    "no width": (
        "metadata.json", lambda r: r["metadata"].update(resolution=[0, 256]), "resolution"
    ),
    "truncated times": (
        "events.json", lambda r: r["collisions"][0].update(frame=9), "collisions.0.frame"
    ),
}  # fmt: skip


@pytest.mark.parametrize("defect", FOLDER_DEFECTS)
def test_a_folder_without_the_published_layout_is_refused(tmp_path: Path, defect: str) -> None:
    name, change, part = FOLDER_DEFECTS[defect]
    path = write_movi_folder(tmp_path / "00012", movi_example([(9.5, 0, 1, 0.5, 0.0)]))
    record = json.loads(path.with_name(name).read_text())
    change(record)
    path.with_name(name).write_text(json.dumps(record))
    with raises_user_error("invalid-record", contains=(str(tmp_path / "00012"), part)):
        movi_a.read_scene(path, tmp_path, "test")


def test_missing_and_damaged_files_of_a_folder_are_named(tmp_path: Path) -> None:
    path = write_movi_folder(tmp_path / "00012", movi_example())
    scene = movi_a.read_scene(path, tmp_path, "test")
    path.with_name("rgba_00007.png").unlink()
    for use in (
        lambda: movi_a.read_scene(path, tmp_path, "test"),
        lambda: movi_a.load_images(scene, tmp_path, [0]),
    ):
        with raises_user_error("missing-file", contains="00012/rgba_00007.png"):
            use()
    path.write_text(path.read_text()[:500])
    with raises_user_error("damaged-file", contains="metadata.json"):
        movi_a.read_scene(path, tmp_path, "test")


RECORD_DEFECTS: dict[str, tuple[Callable[[dict], object], str]] = {
    "no positions": (lambda f: f.pop("instances/positions"), "'instances/positions'"),
    "one value too few": (lambda f: f["instances/positions"].pop(), "215"),
    "MoVi-B's shapes": (
        lambda f: f["instances/shape_label"].__setitem__(1, 9), "instances.1.shape"
    ),
    "one frame too few": (lambda f: f["video"].pop(), "23"),
}  # fmt: skip


@pytest.mark.parametrize("defect", RECORD_DEFECTS)
def test_a_record_without_the_published_layout_is_refused(tmp_path: Path, defect: str) -> None:
    change, named = RECORD_DEFECTS[defect]
    features = movi_features(movi_example())
    change(features)
    write_tfrecord(tmp_path / SHARD, [features])
    (path,) = movi_a.list_scenes(tmp_path)
    with raises_user_error("invalid-record", contains=named):
        movi_a.read_scene(path, tmp_path, "test")


def test_records_before_a_truncated_or_damaged_record_are_read(tmp_path: Path) -> None:
    features = movi_features(movi_example())
    shard = write_tfrecord(tmp_path / SHARD, [features] * 3)
    whole = shard.read_bytes()
    for length in (len(whole) - 500, len(whole) * 2 // 3 + 5):
        shard.write_bytes(whole[:length])
        *good, bad = movi_a.list_scenes(tmp_path)
        assert [movi_a.read_scene(path, tmp_path, "test").frames for path in good] == [24, 24]
        with raises_user_error("damaged-file", contains=f"{SHARD}: record 2"):
            movi_a.read_scene(bad, tmp_path, "test")
    # A byte of the first record's length, and the first tag of its protocol buffer.
    for byte in (5, tfrecord.HEADER):
        shard.write_bytes(whole[:byte] + bytes([whole[byte] ^ 1]) + whole[byte + 1 :])
        with raises_user_error("damaged-file", contains=f"{SHARD}: record 0"):
            movi_a.read_scene(movi_a.list_scenes(tmp_path)[0], tmp_path, "test")


def test_features_have_the_tags_of_tensorflows_example() -> None:
    message = bytes.fromhex(
        "0a370a0b0a01611206 0a040a027879 0a110a0162120c 120a0a080000003f000000c0"
        "0a150a01631210 1a0e0a0cffffffffffffffffff01ac02"
    )
    entries = tfrecord.example_class().FromString(message).features.feature
    values = {entry.key: list(tfrecord.feature_values(entry.value)) for entry in entries}
    assert values == {"a": [b"xy"], "b": [0.5, -2.0], "c": [-1, 300]}
