"""MoVi-A's two forms give the same scene, and contact points become events."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from data.records import Collision, Landing, Scene
from data.releases import movi_a, tfrecord
from data.releases.validation import RecordError
from data.world.shapes import rotation_matrix
from tests.data.releases.movi_a_files import (
    movi_example,
    movi_features,
    write_movi_folder,
    write_tfrecord,
)

SHARD = "movi_a-train.tfrecord-00003-of-00512"


def from_folder(folder: Path, contacts: list) -> Scene:
    path = write_movi_folder(folder / "00012", movi_example(contacts))
    return movi_a.read_scene(path, folder, "test")


def from_record(folder: Path, contacts: list) -> Scene:
    write_tfrecord(folder / SHARD, [movi_features(movi_example(contacts))])
    (path,) = movi_a.list_scenes(folder)
    return movi_a.read_scene(path, folder, "test")


@pytest.fixture(params=[from_folder, from_record])
def read_form(request: pytest.FixtureRequest) -> Callable[[Path, list], Scene]:
    return request.param


def test_a_scene_is_as_published(read_form, tmp_path: Path) -> None:
    scene = read_form(tmp_path, [])
    known = {"movi_a-00012", "movi_a-train-00003-00000"}
    assert scene.scene_id in known
    assert (scene.frames, scene.fps, scene.image_size) == (24, 12, (256, 256))
    assert [o.phrase for o in scene.objects] == [
        "large red metal cube", "small cyan rubber sphere", "small red metal cylinder",
    ]  # fmt: skip
    # Video frame 0 is a twelfth of a second after the physics begins.
    fallen = 5 - 9.81 / 2 * (np.arange(1, 25) / 12) ** 2
    np.testing.assert_allclose(scene.positions[:, 0, 2], fallen, rtol=1e-5)
    np.testing.assert_allclose(scene.positions[:, 1, 0], 1 + np.arange(1, 25) / 12, rtol=1e-5)
    assert np.isnan(scene.visible_fraction).all()
    assert scene.in_view.all(axis=0).tolist() == [True, True, False]


def test_quaternions_begin_with_their_real_part(read_form, tmp_path: Path) -> None:
    scene = read_form(tmp_path, [])
    angle = 12 / 12
    turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    np.testing.assert_allclose(rotation_matrix(scene.quaternions[11, 0]), turn, atol=1e-6)


def test_image_positions_become_pixels(read_form, tmp_path: Path) -> None:
    scene = read_form(tmp_path, [])
    np.testing.assert_allclose(scene.image_positions[:, 0, 0], 128, rtol=1e-6)
    assert scene.image_positions[11, 1, 0] == pytest.approx(256 * (0.5 + 2 / 20))
    assert (np.diff(scene.image_positions[:, 0, 1]) > 0).all()


def test_frames_are_those_asked_for_without_transparency(read_form, tmp_path: Path) -> None:
    scene = read_form(tmp_path, [])
    shown = movi_a.load_images(scene, tmp_path, [17, 2])
    assert {f: image.getpixel((9, 9)) for f, image in shown.items()} == {
        2: (62,) * 3,
        17: (77,) * 3,
    }


SUBSTEP = 0.05


def test_contact_points_become_one_contact_of_a_pair(read_form, tmp_path: Path) -> None:
    many = [(9.1 + SUBSTEP * k, *pair, 0.5, 0.0) for k in range(200) for pair in ((1, 0), (0, 1))]
    assert read_form(tmp_path, many).collisions == (Collision(9, (0, 1)),)


@pytest.mark.parametrize(("time", "raw", "cut"), [(9.0, 8, 9), (9.05, 9, 9), (0.4, 0, 0)])
def test_a_contact_is_at_the_first_frame_that_shows_it(tmp_path: Path, time, raw, cut) -> None:
    """Frame i shows scene frame i + 1. Where the time was cut to an integer, only the next frame is
    surely not before the contact."""
    contact = [(time, 0, 1, 0.5, 0.0)]
    assert from_folder(tmp_path / "a", contact).collisions == (Collision(raw, (0, 1)),)
    assert from_record(tmp_path / "b", contact).collisions == (Collision(cut, (0, 1)),)


def test_events_past_the_last_frame_are_dropped(read_form, tmp_path: Path) -> None:
    late = [(24.05, 0, 1, 0.5, 0.0), (24.3, 0, -1, 0.0, 1.0), (23.2, 1, 2, 0.5, 0.0)]
    scene = read_form(tmp_path, late)
    assert scene.collisions == (Collision(23, (1, 2)),)
    assert scene.landings == ()


def test_the_floor_is_nobody_but_objects_land_on_it(read_form, tmp_path: Path) -> None:
    """-1 is the floor, or an object that is never seen: that one is met above or beside."""
    contacts = [
        (12.3, 0, -1, 0.001, -1.0),
        (12.35, 0, -1, 0.001, -1.0),
        (16.2, -1, 1, 0.0, 0.98),
        (5.0, -1, 2, 0.6, 1.0),
        (6.0, 2, -1, 0.0, 0.1),
        (20.0, -1, -1, 0.0, 1.0),
    ]
    scene = read_form(tmp_path, contacts)
    assert scene.collisions == ()
    assert scene.landings == (Landing(12, 0), Landing(16, 1))


def test_what_is_on_the_floor_at_first_does_not_land(read_form, tmp_path: Path) -> None:
    contacts = [(0.5, 2, -1, 0.0, 1.0), (9.5, 2, -1, 0.0, 1.0), (9.5, 1, -1, 0.0, 1.0)]
    assert read_form(tmp_path, contacts).landings == (Landing(9, 1),)


def test_scenes_of_both_forms_are_found_in_order(tmp_path: Path) -> None:
    for name in ("00012", "00003"):
        write_movi_folder(tmp_path / "raw" / name, movi_example())
    features = movi_features(movi_example())
    (tmp_path / "tfds").mkdir()
    write_tfrecord(tmp_path / "tfds" / SHARD, [features, features])
    for own in ("metadata.json", "dataset_info.json", "features.json"):
        (tmp_path / "tfds" / own).write_text("{}")
    paths = movi_a.list_scenes(tmp_path)
    assert [movi_a.read_scene(p, tmp_path, "test").scene_id for p in paths] == [
        "movi_a-raw-00003", "movi_a-raw-00012",
        "movi_a-train-00003-00000", "movi_a-train-00003-00001",
    ]  # fmt: skip


def edit(path: Path, change: Callable[[dict], object]) -> None:
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


TRAPS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no velocities": (
        lambda p: edit(p, lambda r: r["instances"][1].pop("velocities")),
        "metadata.json lacks the key 'velocities'",
    ),
    "fewer frames": (
        lambda p: edit(p, lambda r: r["metadata"].update(num_frames=12)),
        "12 frames at 12 a second, expected 24 at 12",
    ),
    "another rate": (
        lambda p: edit(p, lambda r: r["metadata"].update(frame_rate=24)),
        "24 frames at 24 a second",
    ),
    "a frame too few in an array": (
        lambda p: edit(p, lambda r: [i["positions"].pop() for i in r["instances"]]),
        r"positions have shape \(3, 23, 3\), expected \(3, 24, 3\)",
    ),
    "MoVi-B's shapes": (
        lambda p: edit(p, lambda r: r["instances"][0].update(shape="teapot")),
        "shape 'teapot', expected cube",
    ),
    "times cut to integers": (
        lambda p: edit(
            p.with_name("events.json"), lambda r: r["collisions"][0].update(frame=9)
        ),
        "events.json has a int under 'frame', expected a float",
    ),
    "no events": (lambda p: p.with_name("events.json").unlink(), "events.json is missing"),
    "broken JSON": (lambda p: p.write_text(p.read_text()[:500]), "metadata.json is not whole"),
    "a frame less": (
        lambda p: p.with_name("rgba_00007.png").unlink(),
        "rgba_00007.png is missing, 1 of 24",
    ),
}  # fmt: skip


@pytest.mark.parametrize("trap", TRAPS)
def test_a_folder_that_is_nearly_right_is_refused(tmp_path: Path, trap: str) -> None:
    spoil, said = TRAPS[trap]
    path = write_movi_folder(tmp_path / "00012", movi_example([(9.5, 0, 1, 0.5, 0.0)]))
    spoil(path)
    with pytest.raises(RecordError, match=said) as refusal:
        movi_a.read_scene(path, tmp_path, "test")
    assert str(refusal.value).startswith(str(tmp_path / "00012"))


def test_a_folder_that_went_away_is_named(tmp_path: Path) -> None:
    path = write_movi_folder(tmp_path / "00012", movi_example([(9.5, 0, 1, 0.5, 0.0)]))
    scene = movi_a.read_scene(path, tmp_path, "test")
    shutil.rmtree(tmp_path / "00012")
    for look in (lambda: movi_a.check_frames(scene, tmp_path),
                 lambda: movi_a.load_images(scene, tmp_path, [0])):  # fmt: skip
        with pytest.raises(RecordError, match="00012 is missing"):
            look()


RECORD_TRAPS: dict[str, tuple[Callable[[dict], object], str]] = {
    "no positions": (
        lambda f: f.pop("instances/positions"),
        "lacks the feature 'instances/positions'",
    ),
    "a value less": (
        lambda f: f["instances/positions"].pop(),
        "215 values of 'instances/positions', expected 216",
    ),
    "MoVi-B's shapes": (
        lambda f: f.update({"instances/shape_label": [0, 9, 1]}),
        "numbers a shape 9, of 3 words",
    ),
    "a frame less": (lambda f: f["video"].pop(), "a video of 23 frames, expected 24"),
}


@pytest.mark.parametrize("trap", RECORD_TRAPS)
def test_a_record_that_is_nearly_right_is_refused(tmp_path: Path, trap: str) -> None:
    spoil, said = RECORD_TRAPS[trap]
    features = movi_features(movi_example())
    spoil(features)
    write_tfrecord(tmp_path / SHARD, [features])
    (path,) = movi_a.list_scenes(tmp_path)
    with pytest.raises(RecordError, match=said):
        movi_a.read_scene(path, tmp_path, "test")


def test_a_shard_that_is_cut_off_keeps_what_is_whole(tmp_path: Path) -> None:
    features = movi_features(movi_example())
    shard = write_tfrecord(tmp_path / SHARD, [features] * 3)
    whole = shard.read_bytes()
    for cut in (len(whole) - 500, len(whole) * 2 // 3 + 5):
        shard.write_bytes(whole[:cut])
        *good, bad = movi_a.list_scenes(tmp_path)
        assert [movi_a.read_scene(path, tmp_path, "test").frames for path in good] == [24, 24]
        with pytest.raises(RecordError, match=f"{SHARD}: record 2"):
            movi_a.read_scene(bad, tmp_path, "test")
    shard.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])
    (bad,) = movi_a.list_scenes(tmp_path)
    with pytest.raises(RecordError, match="does not begin with a length and its checksum"):
        movi_a.read_scene(bad, tmp_path, "test")


def test_the_checksum_is_crc_32c() -> None:
    """The check value of the Castagnoli polynomial, masked."""
    crc = 0xE3069283
    assert tfrecord.masked_crc(b"123456789") == ((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32


def test_only_the_features_asked_for_are_read(tmp_path: Path) -> None:
    write_tfrecord(tmp_path / "x", [{"a": [-1, 2**40, 0], "b": [0.5, -2.0], "c": [b"", b"\xff"]}])
    found = tfrecord.example(tmp_path / "x", 0, ("a", "c"))
    assert found["a"].tolist() == [-1, 2**40, 0]
    assert found["c"] == [b"", b"\xff"]
    assert set(found) == {"a", "c"}
    assert tfrecord.example(tmp_path / "x", 0, ("b",))["b"].tolist() == [0.5, -2.0]
