"""Files in the published layout of CLEVRER are read; damaged, missing and other files are
refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynapix.data.records import Collision
from dynapix.data.sim.shapes import half_height, rotation_matrix
from dynapix.data.sources import clevrer
from tests.data.sources.clevrer_files import clevrer_annotation, write_clevrer_scene
from tests.user_errors import raises_user_error


def test_a_scene_has_the_values_of_its_annotation(tmp_path: Path) -> None:
    write_clevrer_scene(tmp_path, clevrer_annotation(7), 7)
    (path,) = clevrer.list_scenes(tmp_path)
    scene = clevrer.read_scene(path, tmp_path, "test")
    assert (scene.scene_id, scene.split, scene.fps) == ("clevrer-00007", "test", 25)
    assert [o.noun_phrase for o in scene.objects] == ["red metal cube", "blue rubber sphere"]
    assert scene.collisions == (Collision(20, (0, 1), 20),)
    np.testing.assert_allclose(scene.positions[40, 1], [0.5, 1.0, 0.2], rtol=1e-6)
    np.testing.assert_allclose(scene.velocities[40, 1], [0, 1.25, 0])
    np.testing.assert_allclose(scene.angular_velocities[40, 1], [-6.25, 0, 0])
    np.testing.assert_allclose(scene.image_positions[:, 0], np.tile([240, 160], (128, 1)))
    # in_view is read from the annotation instead of being computed from the camera.
    assert scene.in_view[:, 1].tolist() == [f < 90 for f in range(128)]
    assert (scene.visible_fraction[:, 0] == 1).sum() < 128
    # The release's cubes are larger than ours.
    assert scene.object_radii == (0.2, 0.2)
    sizes = zip(scene.objects, scene.object_scales, strict=True)
    assert [half_height(each.shape, scale) for each, scale in sizes] == pytest.approx([0.2, 0.2])
    # Orientations are extrinsic xyz angles.
    x, y, z = (Rotation.from_rotvec(a * np.eye(3)[k]) for k, a in enumerate((0.3, -0.5, 1.1)))
    turn = rotation_matrix(scene.quaternions[0, 0])
    np.testing.assert_allclose(turn, (z * y * x).as_matrix(), atol=1e-6)
    images = clevrer.load_images(scene, tmp_path, [100, 5, 127])
    assert sorted(images) == [5, 100, 127]
    for frame, image in images.items():
        assert np.asarray(image).mean() == pytest.approx(frame + 60, abs=1.5)
    assert clevrer.load_images(scene, tmp_path, []) == {}


def test_an_upright_cylinder_of_the_release_has_the_axis_z(tmp_path: Path) -> None:
    """The release's cylinders have the axis y: [pi/2, 0, a] is upright, whatever the angle a."""
    orientations = {(np.pi / 2, 0, 0.8): (0, 0, 1), (0, 0, 0): (0, 1, 0)}
    for k, (angles, axis) in enumerate(orientations.items()):
        record = clevrer_annotation(k)
        record["object_property"][0]["shape"] = "cylinder"
        for moment in record["motion_trajectory"]:
            moment["objects"][0]["orientation"] = list(map(float, angles))
        path, _ = write_clevrer_scene(tmp_path, record, k)
        turn = rotation_matrix(clevrer.read_scene(path, tmp_path, "test").quaternions[0, 0])
        np.testing.assert_allclose(turn[:, 2], axis, atol=1e-6)


DEFECTS: dict[str, tuple[Callable[[dict], object], str]] = {
    "a key of another name": (lambda r: r.update(collisions=r.pop("collision")), "collision:"),
    "quaternions": (
        lambda r: r["motion_trajectory"][3]["objects"][1].update(orientation=[0.0, 0.0, 0.0, 1.0]),
        "objects.1.orientation",
    ),
    "a frame without an object": (
        lambda r: r["motion_trajectory"][9]["objects"].pop(0), "frame 9"
    ),
    "one frame too few": (lambda r: r["motion_trajectory"].pop(), "127"),
    "two objects of one id": (
        lambda r: r["object_property"].append(r["object_property"][0]), "the id 0"
    ),
    "a collision of an object with itself": (
        lambda r: r["collision"][0].update(object_ids=[1, 1]), "[1, 1]"
    ),
    "a collision after the last frame": (
        lambda r: r["collision"][0].update(frame_id=128), "collision.0.frame_id"
    ),
    "a video in another folder": (
        lambda r: r.update(video_filename="../video_00000.mp4"), "video_filename"
    ),
}  # fmt: skip


@pytest.mark.parametrize("defect", DEFECTS)
def test_an_annotation_without_the_published_layout_is_refused(tmp_path: Path, defect: str) -> None:
    change, named = DEFECTS[defect]
    record = clevrer_annotation()
    change(record)
    path, _ = write_clevrer_scene(tmp_path, record, video_frames=1)
    with raises_user_error("invalid-record", contains=(str(path), named)):
        clevrer.read_scene(path, tmp_path, "test")


def test_damaged_and_missing_files_are_refused(tmp_path: Path) -> None:
    truncated = json.dumps(clevrer_annotation())[:4000]
    for text, code in ((truncated, "damaged-file"), ("[]", "invalid-record")):
        path, _ = write_clevrer_scene(tmp_path, text, video_frames=1)
        with raises_user_error(code, contains="annotation_00000.json"):
            clevrer.read_scene(path, tmp_path, "test")
    path, video = write_clevrer_scene(tmp_path, clevrer_annotation(), video_frames=120)
    with raises_user_error("invalid-record", contains=("video_00000.mp4", "120")):
        clevrer.read_scene(path, tmp_path, "test")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    with raises_user_error("damaged-file", contains="video_00000.mp4"):
        clevrer.read_scene(path, tmp_path, "test")
    video.unlink()
    with raises_user_error("missing-file", contains="video_00000.mp4"):
        clevrer.read_scene(path, tmp_path, "test")


def test_scenes_are_listed_in_order_and_duplicates_are_refused(tmp_path: Path) -> None:
    with raises_user_error("empty-release", contains="annotation_train/"):
        clevrer.list_scenes(tmp_path)
    for index in (1200, 3, 10):
        write_clevrer_scene(tmp_path / "original", clevrer_annotation(index), index, 1)
    paths = clevrer.list_scenes(tmp_path / "original")
    assert [path.stem[-5:] for path in paths] == ["00003", "00010", "01200"]
    copy = paths[0].with_name("annotation_00003 (1).json")
    copy.write_bytes(paths[0].read_bytes())
    with raises_user_error("duplicate-scene", contains="clevrer-00003"):
        clevrer.list_scenes(tmp_path)
    # A copy of another scene under a number of its own.
    for key, value in (("video_filename", "video_00000.mp4"), ("scene_index", 0)):
        record = clevrer_annotation(5) | {key: value}
        path, _ = write_clevrer_scene(tmp_path / key, record, 5, 1)
        with raises_user_error("duplicate-scene", contains=(str(path), key)):
            clevrer.read_scene(path, tmp_path / key, "test")
