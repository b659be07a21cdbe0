"""CLEVRER's release is read as published, what only looks like it is refused, and what is exported
is read back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conf.errors import UserError
from conf.schema import BenchmarkConfig
from data.publish.clevrer_format import write_clevrer
from data.records import Collision
from data.releases import clevrer
from data.releases.validation import RecordError
from data.render import get_renderer
from data.world.sampling import simulate_scene
from data.world.shapes import rotation_matrix
from tests.data.releases.clevrer_files import clevrer_annotation, write_clevrer_scene


def test_a_scene_is_as_its_annotation_says(tmp_path: Path) -> None:
    write_clevrer_scene(tmp_path, clevrer_annotation(7), 7)
    (path,) = clevrer.list_scenes(tmp_path)
    scene = clevrer.read_scene(path, tmp_path, "test")
    assert (scene.scene_id, scene.split, scene.fps) == ("clevrer-00007", "test", 25)
    assert [o.phrase for o in scene.objects] == ["red metal cube", "blue rubber sphere"]
    assert scene.collisions == (Collision(20, (0, 1)),)
    np.testing.assert_allclose(scene.positions[40, 1], [0.5, 1.0, 0.2], rtol=1e-6)
    np.testing.assert_allclose(scene.velocities[40, 1], [0, 1.25, 0])
    np.testing.assert_allclose(scene.angular_velocities[40, 1], [-6.25, 0, 0])
    np.testing.assert_allclose(scene.image_positions[:, 0], np.tile([240, 160], (128, 1)))
    # The flag is the annotation's, whatever the camera would see.
    assert scene.in_view[:, 1].tolist() == [f < 90 for f in range(128)]
    assert (scene.visible_fraction[:, 0] == 1).sum() < 128


def test_angles_turn_about_fixed_axes_x_first(tmp_path: Path) -> None:
    path, _ = write_clevrer_scene(tmp_path, clevrer_annotation())
    turn = rotation_matrix(clevrer.read_scene(path, tmp_path, "test").quaternions[0, 0])
    (a, b, c) = (0.3, -0.5, 1.1)
    x = [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
    y = [[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]]
    z = [[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]
    np.testing.assert_allclose(turn, np.array(z) @ y @ x, atol=1e-6)


def test_frames_are_those_asked_for(tmp_path: Path) -> None:
    path, _ = write_clevrer_scene(tmp_path, clevrer_annotation())
    scene = clevrer.read_scene(path, tmp_path, "test")
    shown = clevrer.load_images(scene, tmp_path, [100, 5, 127])
    assert sorted(shown) == [5, 100, 127]
    for frame, image in shown.items():
        assert np.asarray(image).mean() == pytest.approx(frame + 60, abs=1.5)
    assert clevrer.load_images(scene, tmp_path, []) == {}


def rename(record: dict) -> None:
    record["collisions"] = record.pop("collision")


def four_numbers(record: dict) -> None:
    for moment in record["motion_trajectory"]:
        for state in moment["objects"]:
            state["orientation"] = [0.0, 0.0, 0.0, 1.0]


TRAPS: dict[str, tuple[Callable[[dict], object], str]] = {
    "another generator's key": (rename, "'collisions' where .* 'collision'"),
    "quaternions": (four_numbers, "orientations of four numbers"),
    "no velocity": (
        lambda r: r["motion_trajectory"][3]["objects"][1].pop("velocity"),
        "frame 3 lacks the key 'velocity'",
    ),
    "no view flag": (
        lambda r: r["motion_trajectory"][3]["objects"][1].pop("inside_camera_view"),
        "frame 3 lacks the key 'inside_camera_view'",
    ),
    "a flat location": (
        lambda r: [m["objects"][0].update(location=[0, 0]) for m in r["motion_trajectory"]],
        "'location' are not numbers of shape",
    ),
    "an object that is left out": (
        lambda r: r["motion_trajectory"][9]["objects"].pop(0),
        r"frame 9 lists objects \[1\], expected \[0, 1\]",
    ),
    "a frame too few": (lambda r: r["motion_trajectory"].pop(), "127 frames, expected 0 to 127"),
    "an unknown shape": (
        lambda r: r["object_property"][0].update(shape="cone"),
        "shape 'cone', expected cube",
    ),
    "a collision with nobody": (
        lambda r: r["collision"][0].update(object_ids=[0, 5]),
        r"objects \[0, 5\] at frame 20, expected two of \[0, 1\]",
    ),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_what_only_looks_like_a_release_is_refused(tmp_path: Path, trap: str) -> None:
    spoil, said = TRAPS[trap]
    record = clevrer_annotation()
    spoil(record)
    path, _ = write_clevrer_scene(tmp_path, record)
    with pytest.raises(RecordError, match=said) as refusal:
        clevrer.read_scene(path, tmp_path, "test")
    assert str(refusal.value).startswith(str(path))


@pytest.mark.parametrize("text", ["", "[]", json.dumps(clevrer_annotation())[:4000]])
def test_a_broken_annotation_is_refused(tmp_path: Path, text: str) -> None:
    path, _ = write_clevrer_scene(tmp_path, text, 10800)
    with pytest.raises(RecordError, match=r"annotation_10800.json (is not whole|holds a list)"):
        clevrer.read_scene(path, tmp_path, "test")


def test_a_video_that_is_not_whole_is_refused(tmp_path: Path) -> None:
    path, video = write_clevrer_scene(tmp_path, clevrer_annotation(), video_frames=120)
    with pytest.raises(RecordError, match=r"video_00000.mp4 has 120 frames, expected 128"):
        clevrer.read_scene(path, tmp_path, "test")
    whole = video.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"no video at all"):
        video.write_bytes(damaged)
        with pytest.raises(
            RecordError, match=r"video_00000.mp4 (cannot be decoded|has [0-9]+ frames)"
        ):
            clevrer.read_scene(path, tmp_path, "test")
    video.unlink()
    with pytest.raises(RecordError, match=r"video_00000.mp4 is missing"):
        clevrer.read_scene(path, tmp_path, "test")


def test_a_folder_without_scenes_is_refused_with_the_layout(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no scene: expected annotation_train/"):
        clevrer.list_scenes(tmp_path)
    with pytest.raises(UserError, match="there is no folder"):
        clevrer.list_scenes(tmp_path / "nowhere")


def test_scenes_come_in_order_and_once(tmp_path: Path) -> None:
    for index in (1200, 3, 10):
        write_clevrer_scene(tmp_path / "here", clevrer_annotation(index), index, 1)
    names = [path.stem for path in clevrer.list_scenes(tmp_path / "here")]
    assert names == ["annotation_00003", "annotation_00010", "annotation_01200"]
    write_clevrer_scene(tmp_path / "copy", clevrer_annotation(3), 3, 1)
    with pytest.raises(UserError, match="holds scene clevrer-00003 twice"):
        clevrer.list_scenes(tmp_path)


def test_what_is_exported_is_read_back(tmp_path: Path) -> None:
    scene = simulate_scene(0, 0, "train", BenchmarkConfig(name="export"))
    assert not scene.in_view.all()
    drawn = {f: get_renderer("bullet", 192, 128).render(scene, f) for f in range(scene.frames)}
    annotation, video = write_clevrer(scene, drawn, tmp_path, 10_042)
    block = "validation/{0}_10000-11000/{0}_10042"
    assert annotation == tmp_path / f"annotation_{block.format('annotation')}.json"
    assert video == tmp_path / f"video_{block.format('video')}.mp4"
    assert clevrer.list_scenes(tmp_path) == [annotation]
    again = clevrer.read_scene(annotation, tmp_path, "test")
    assert (again.objects, again.collisions) == (scene.objects, scene.collisions)
    for name in ("positions", "velocities", "angular_velocities", "in_view"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene, name))
    np.testing.assert_allclose(again.image_positions, scene.image_positions, atol=1e-3)
    turns, turned = (
        Rotation.from_quat(s.quaternions.reshape(-1, 4).astype(float)) for s in (scene, again)
    )
    assert (turns.inv() * turned).magnitude().max() < 1e-5
    shown = clevrer.load_images(again, tmp_path, range(128))
    for frame, image in drawn.items():
        error = np.square(np.asarray(image, float) - np.asarray(shown[frame], float)).mean()
        assert 10 * np.log10(255**2 / error) > 35


def test_only_what_clevrer_has_is_exported(tmp_path: Path) -> None:
    path, _ = write_clevrer_scene(tmp_path, clevrer_annotation())
    scene = clevrer.read_scene(path, tmp_path, "test")
    drawn = clevrer.load_images(scene, tmp_path, range(128))
    with pytest.raises(UserError, match="numbered 0 to 14999"):
        write_clevrer(scene, drawn, tmp_path / "new", 15_000)
    with pytest.raises(UserError, match="128 frames and 127 images"):
        write_clevrer(scene, {f: drawn[f] for f in range(127)}, tmp_path / "new", 0)
    assert not (tmp_path / "new").exists()
