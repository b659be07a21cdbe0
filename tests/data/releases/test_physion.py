"""Physion's raw trials: axes, cameras and views, and the three kinds of event."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data.records import Collision, Landing, Scene
from data.releases import physion
from data.releases.validation import RecordError
from data.world.events import find_motion_onsets
from tests.data.releases.physion_files import IDS, physion_trial, write_physion

A, B, C = IDS


def read(folder: Path, trial: dict, **version: object) -> Scene:
    path = write_physion(folder / "Collide" / "box" / "0003.hdf5", trial, **version)
    return physion.read_scene(path, folder, "test")


def test_a_trial_is_as_its_file_says(tmp_path: Path) -> None:
    scene = read(tmp_path, physion_trial())
    assert (scene.scene_id, scene.scenario) == ("physion-Collide-Collide_box_0003", "Collide")
    assert (scene.frames, scene.fps, scene.image_size) == (60, 30, (48, 32))
    assert [o.phrase for o in scene.objects] == ["bowl", "cone", "bowl"]
    assert np.isnan(scene.visible_fraction).all()
    assert scene.footage == "Collide/box/0003.hdf5"
    shown = physion.load_images(scene, tmp_path, [59, 0])
    assert {f: image.getpixel((1, 1))[0] for f, image in shown.items()} == {0: 60, 59: 119}


def test_the_frame_rate_is_the_callers(tmp_path: Path) -> None:
    path = write_physion(tmp_path / "drop" / "0000.hdf5", physion_trial())
    assert physion.read_scene(path, tmp_path, "test", fps=100).fps == 100


def test_up_is_z_and_a_fall_is_down(tmp_path: Path) -> None:
    trial = physion_trial()
    t = np.arange(60) / 30
    trial["positions"][:, 0] = np.stack([t, 9 - 9.81 / 2 * t**2, 2 + 0 * t], -1)
    trial["velocities"][:, 0] = np.stack([1 + 0 * t, -9.81 * t, 0 * t], -1)
    scene = read(tmp_path, trial)
    np.testing.assert_allclose(scene.positions[:, 0, 2], 9 - 9.81 / 2 * t**2, rtol=1e-5)
    np.testing.assert_allclose(scene.positions[:, 0, 1], 2)
    moved = np.gradient(scene.positions[:, 0], 1 / 30, axis=0)[1:-1]
    np.testing.assert_allclose(moved, scene.velocities[1:-1, 0], atol=1e-4)


def test_rotations_turn_as_their_velocities_say_and_as_the_object_does(tmp_path: Path) -> None:
    """A turn about TDW's axes stays the same turn of the same points, seen from other axes; its
    angular velocity moves a point at the velocity w x r in both."""
    trial = physion_trial()
    spin = np.array([0.3, -0.8, 0.5])
    turns = Rotation.from_rotvec(np.outer(np.arange(60) / 30, spin))
    turns = turns * Rotation.from_euler("xyz", [0.4, 1.0, -0.2])
    trial["rotations"][:, 1] = turns.as_quat()
    trial["angular_velocities"][:, 1] = spin
    scene = read(tmp_path, trial)
    ours = Rotation.from_quat(scene.quaternions[:, 1].astype(float))
    corner = np.array([0.1, 0.5, -0.3])
    there = turns.apply(corner)[:, [0, 2, 1]]
    np.testing.assert_allclose(ours.apply(corner[[0, 2, 1]]), there, atol=1e-5)
    moved = np.gradient(there, 1 / 30, axis=0)[1:-1]
    expected = np.cross(scene.angular_velocities[1:-1, 1], there[1:-1])
    np.testing.assert_allclose(moved, expected, atol=1e-3)


def test_centres_are_seen_where_the_camera_says(tmp_path: Path) -> None:
    trial = physion_trial()
    looking = np.diag([1.0, 1.0, -1.0, 1.0])
    looking[:3, 3] = [0, -1, -4]
    trial["camera"] = (looking, trial["camera"][1])
    trial["positions"][:] = [[0, 1, 0], [1, 2, 0], [0, 1, -9]]
    seen = read(tmp_path, trial).image_positions[0]
    np.testing.assert_allclose(seen[0], [24, 16])
    # One to the right and one up, four away, of focal lengths 1.5 and 2 half images: 3/8 and 1/2.
    np.testing.assert_allclose(seen[1], [24 * (1 + 3 / 8), 16 * (1 - 1 / 2)], rtol=1e-6)
    assert np.isfinite(seen).all()


def test_an_object_is_in_view_where_its_colour_is(tmp_path: Path) -> None:
    trial = physion_trial()
    trial["hidden"] = {4: (1,), 5: (0, 1, 2)}
    in_view = read(tmp_path, trial).in_view
    assert in_view[3:7].tolist() == [[1, 1, 1], [1, 0, 1], [0, 0, 0], [1, 1, 1]]


def test_later_versions_name_cameras_and_begin_at_frame_one(tmp_path: Path) -> None:
    trial = physion_trial()
    trial["pairs"][30], trial["states"][30] = [[A, B]], [b"enter"]
    early = read(tmp_path / "early", trial)
    late = read(tmp_path / "late", trial, suffix="_cam0", first=1)
    assert late.collisions == early.collisions == (Collision(30, (0, 1)),)
    for name in ("positions", "image_positions", "in_view"):
        np.testing.assert_array_equal(getattr(late, name), getattr(early, name))
    shown = physion.load_images(late, tmp_path / "late", [0])
    assert shown[0].getpixel((1, 1)) == (60, 60, 60)


# A1


def touch(trial: dict, first: int, last: int, pair: list[int], enters: bool = True) -> None:
    """A pair that touches from one frame to another, then parts."""
    for frame in range(first, last + 2):
        state = b"enter" if enters and frame == first else b"stay" if frame <= last else b"exit"
        trial["pairs"][frame].append(pair)
        trial["states"][frame].append(state)


def test_a_contact_is_the_first_frame_that_a_pair_enters(tmp_path: Path) -> None:
    trial = physion_trial()
    touch(trial, 20, 24, [C, A])
    touch(trial, 40, 44, [A, C])
    touch(trial, 22, 30, [B, C])
    touch(trial, 25, 26, [A, 99])
    touch(trial, 28, 29, [B, B])
    assert read(tmp_path, trial).collisions == (Collision(20, (0, 2)), Collision(22, (1, 2)))


@pytest.mark.parametrize("enters", [True, False])
def test_pairs_that_touch_at_first_are_left_out(tmp_path: Path, enters: bool) -> None:
    trial = physion_trial()
    touch(trial, 0, 10, [A, B], enters)
    touch(trial, 30, 35, [B, A])
    touch(trial, 33, 35, [B, C])
    assert read(tmp_path, trial).collisions == (Collision(33, (1, 2)),)


def test_without_states_a_contact_is_a_first_listing_after_some_frames(tmp_path: Path) -> None:
    trial = physion_trial()
    # In the first frame the physics may not have begun: what rests is listed a little later.
    touch(trial, 1, 50, [A, B])
    touch(trial, 20, 22, [B, C])
    touch(trial, 30, 32, [C, B])
    assert read(tmp_path, trial, states=False).collisions == (Collision(20, (1, 2)),)


# A2


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return read(tmp_path_factory.mktemp("rest"), physion_trial())


def onset_of(scene: Scene, way: np.ndarray) -> list[tuple[int, int]]:
    """Onsets where the second object goes so far from its place."""
    positions = scene.positions.copy()
    positions[:, 1, 0] += np.float32(way)
    return find_motion_onsets(replace(scene, positions=positions))


def test_motion_sets_in_where_an_object_leaves_its_place_for_good(at_rest: Scene) -> None:
    f = np.arange(60)
    assert onset_of(at_rest, np.maximum(f - 20, 0) * 0.004) == [(23, 1)]
    assert onset_of(at_rest, np.where(f >= 30, 0.02, 0.0)) == [(30, 1)]


def test_jitter_and_what_never_rested_set_nothing_off(at_rest: Scene) -> None:
    f = np.arange(60)
    assert onset_of(at_rest, 0.004 * (f % 2)) == []
    assert onset_of(at_rest, np.where((f == 20) | (f == 21), 0.5, 0)) == []
    assert onset_of(at_rest, 0.003 * f) == []
    assert onset_of(at_rest, np.where(f >= 58, 0.5, 0)) == []


# A3

UP, SIDE = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


def test_a_landing_is_the_first_touch_of_the_floor_after_a_flight(tmp_path: Path) -> None:
    trial = physion_trial()
    for frame in range(60):
        if frame >= 25:
            trial["room"][frame].append(A)
            trial["points"][frame].append((UP, (-1.1, 0.0, 0.0)))
        if frame not in range(30, 50):
            trial["room"][frame].append(C)
            trial["points"][frame].append((UP, (1.1, 0.001, 0.0)))
    # A bounce lands once.
    trial["room"][27], trial["points"][27] = [], []
    assert read(tmp_path, trial).landings == (Landing(25, 0), Landing(50, 2))


@pytest.mark.parametrize(
    ("normal", "point"),
    [(SIDE, (-1.0, 0.0, 0.0)), (UP, (-1.0, 0.4, 0.0)), ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0))],
)
def test_walls_shelves_and_ceilings_are_no_ground(tmp_path: Path, normal, point) -> None:
    trial = physion_trial()
    trial["room"][30], trial["points"][30] = [A], [(normal, point)]
    assert read(tmp_path, trial).landings == ()


def test_any_contact_ends_a_flight(tmp_path: Path) -> None:
    trial = physion_trial()
    touch(trial, 20, 28, [A, B])
    for frame in (31, 40):
        trial["room"][frame], trial["points"][frame] = [A], [(UP, (-1.0, 0.0, 0.0))]
    assert read(tmp_path, trial).landings == (Landing(40, 0),)


def test_a_point_belongs_to_the_nearest_that_touches_the_room(tmp_path: Path) -> None:
    """Walls and floor are mixed and points are not listed by object: A lands while C, also after a
    flight, meets a wall high above."""
    trial = physion_trial()
    trial["room"][30] = [C, A]
    trial["points"][30] = [(SIDE, (1.2, 0.9, 0.0)), (UP, (-0.9, 0.0, 0.1))]
    assert read(tmp_path, trial).landings == (Landing(30, 0),)


# What is refused


def spoil(change: Callable[[h5py.File], object]) -> Callable[[Path], None]:
    def spoiled(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return spoiled


TRAPS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no velocities": (
        spoil(lambda f: f.__delitem__("frames/0007/objects/velocities")),
        "/frames/0007/objects/velocities is missing, expected a dataset",
    ),
    "no segmentation": (
        spoil(lambda f: f.__delitem__("frames/0007/images/_id")),
        "/frames/0007/images/_id is missing",
    ),
    "no image": (
        spoil(lambda f: f.__delitem__("frames/0007/images/_img")),
        "/frames/0007/images/_img is missing",
    ),
    "no camera": (
        spoil(lambda f: f.__delitem__("frames/0007/camera_matrices")),
        "/frames/0007/camera_matrices is missing, expected a group",
    ),
    "a frame that is left out": (
        spoil(lambda f: f.__delitem__("frames/0007")),
        "has 0008, expected 0007 there",
    ),
    "no frames": (spoil(lambda f: f.__delitem__("frames")), "/frames is missing"),
    "an object less in a frame": (
        spoil(
            lambda f: (
                f.__delitem__("frames/0007/objects/positions"),
                f.create_dataset("frames/0007/objects/positions", data=np.zeros((2, 3))),
            )
        ),
        r"positions have shape \(2, 3\), expected \(3, 3\)",
    ),
    "a place that is no number": (
        spoil(lambda f: f["frames/0007/objects/positions"].write_direct(np.full((3, 3), np.nan))),
        "positions are not all finite",
    ),
    "half a pair": (
        spoil(
            lambda f: (
                f.__delitem__("frames/0007/collisions/object_ids"),
                f.create_dataset("frames/0007/collisions/object_ids", data=[3]),
            )
        ),
        r"collisions/object_ids are int64 of shape \(1,\), expected whole numbers",
    ),
    "a name less": (
        spoil(
            lambda f: (
                f.__delitem__("static/model_names"),
                f.create_dataset("static/model_names", data=[b"bowl"]),
            )
        ),
        "names 1 models of 3 objects",
    ),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_a_trial_that_is_nearly_right_is_refused(tmp_path: Path, trap: str) -> None:
    change, said = TRAPS[trap]
    path = write_physion(tmp_path / "roll" / "0000.hdf5", physion_trial(12))
    change(path)
    with pytest.raises(RecordError, match=said) as refusal:
        physion.read_scene(path, tmp_path, "test")
    assert str(refusal.value).startswith(str(path))


@pytest.mark.parametrize("kept", [0, 0.01, 0.3, 0.6, 0.99])
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, kept: float) -> None:
    path = write_physion(tmp_path / "roll" / "0000.hdf5", physion_trial(12))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(RecordError, match=r"0000\.hdf5 is no HDF5 file, damaged or cut off"):
        physion.read_scene(path, tmp_path, "test")


@pytest.mark.parametrize(
    ("folder", "stimulus", "scenario"),
    [
        ("Dominoes", "", "Dominoes"),
        ("pilot_towers_nb2_fr015", "", "Support"),
        ("0", "pilot_it2_rollingSliding_simple_collision_box_0017", "Roll"),
        ("pilot-containment-cone-plate", "", "Contain"),
        ("controllers", "pilot_linking_nl1-8", "Link"),
        ("clothSagging", "", "Drape"),
    ],
)
def test_the_scenario_is_in_the_path_or_the_name(
    tmp_path: Path, folder: str, stimulus: str, scenario: str
) -> None:
    path = tmp_path / folder / "0000.hdf5"
    write_physion(path, {**physion_trial(12), "stimulus_name": stimulus})
    scene = physion.read_scene(path, tmp_path, "test")
    assert scene.scenario == scenario
    assert scene.scene_id == f"physion-{scenario}-{folder}_0000"


def test_a_trial_of_no_known_scenario_is_refused(tmp_path: Path) -> None:
    path = write_physion(tmp_path / "0" / "0.hdf5", {**physion_trial(12), "stimulus_name": "x"})
    with pytest.raises(RecordError, match="tells one of Dominoes, Support"):
        physion.read_scene(path, tmp_path, "test")
