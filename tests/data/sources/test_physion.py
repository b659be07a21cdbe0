"""Physion's raw trials are read: axes, cameras, visibility, three kinds of event, and defects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dynapix.data.oracle.events import collision_frames, find_motion_onsets, first_collisions
from dynapix.data.records import Collision, Landing, Scene
from dynapix.data.sources import physion
from tests.data.sources.physion_files import COLORS, IDS, physion_trial, write_physion
from tests.user_errors import raises_user_error

A, B, C = IDS


def read(
    folder: Path, trial: dict, fps: float = 100, scenario: str = "Collide", **version: object
) -> Scene:
    path = write_physion(folder / scenario / "box" / "0003.hdf5", trial, **version)
    return physion.read_scene(path, folder, "test", fps=fps)


def test_a_scene_has_the_values_of_its_trial(tmp_path: Path) -> None:
    trial = physion_trial()
    trial["pairs"][30], trial["states"][30] = [[A, B]], [b"enter"]
    scene = read(tmp_path / "early", trial)
    assert (scene.scene_id, scene.scenario) == ("physion-Collide-Collide_box_0003", "Collide")
    assert (scene.frames, scene.fps, scene.image_size) == (60, 100, (48, 32))
    assert [o.noun_phrase for o in scene.objects] == ["bowl", "cone", "bowl"]
    assert np.isnan(scene.visible_fraction).all()
    assert scene.footage == "Collide/box/0003.hdf5"
    # Later versions have other keys and another first frame, and some record their frame rate.
    late = read(tmp_path / "late", trial | {"framerate": 50}, suffix="_cam0", first=1)
    assert late.fps == 50
    assert late.collisions == scene.collisions == (Collision(30, (0, 1), 30),)
    for name in ("positions", "image_positions", "in_view"):
        np.testing.assert_array_equal(getattr(late, name), getattr(scene, name))
    for version in ("early", "late"):
        images = physion.load_images(scene, tmp_path / version, [59, 0])
        shown = {f: image.getpixel((1, 1))[0] for f, image in images.items()}
        assert shown == {0: 60, 59: 119}


def test_up_is_z_and_a_fall_is_down(tmp_path: Path) -> None:
    trial = physion_trial()
    t = np.arange(60) / 30
    trial["positions"][:, 0] = np.stack([t, 9 - 9.81 / 2 * t**2, 2 + 0 * t], -1)
    trial["velocities"][:, 0] = np.stack([1 + 0 * t, -9.81 * t, 0 * t], -1)
    scene = read(tmp_path, trial, fps=30)
    np.testing.assert_allclose(scene.positions[:, 0, 2], 9 - 9.81 / 2 * t**2, rtol=1e-5)
    np.testing.assert_allclose(scene.positions[:, 0, 1], 2)
    moved = np.gradient(scene.positions[:, 0], 1 / 30, axis=0)[1:-1]
    np.testing.assert_allclose(moved, scene.velocities[1:-1, 0], atol=1e-4)


def test_rotations_agree_with_angular_velocities(tmp_path: Path) -> None:
    """After the axes of Physion's simulator are converted to ours, a rotation still moves a point
    to its (converted) position, at the cross product of angular velocity and position."""
    trial = physion_trial()
    spin = np.array([0.3, -0.8, 0.5])
    turns = Rotation.from_rotvec(np.outer(np.arange(60) / 30, spin))
    turns = turns * Rotation.from_euler("xyz", [0.4, 1.0, -0.2])
    trial["rotations"][:, 1] = turns.as_quat()
    trial["angular_velocities"][:, 1] = spin
    scene = read(tmp_path, trial)
    ours = Rotation.from_quat(scene.quaternions[:, 1].astype(float))
    corner = np.array([0.1, 0.5, -0.3])
    expected = turns.apply(corner)[:, [0, 2, 1]]
    np.testing.assert_allclose(ours.apply(corner[[0, 2, 1]]), expected, atol=1e-5)
    moved = np.gradient(expected, 1 / 30, axis=0)[1:-1]
    velocity = np.cross(scene.angular_velocities[1:-1, 1], expected[1:-1])
    np.testing.assert_allclose(moved, velocity, atol=1e-3)


def test_centres_are_projected_by_the_recorded_camera(tmp_path: Path) -> None:
    """Positions are those of the pivots, at the base. An object without bounds keeps its own."""
    trial = physion_trial()
    looking = np.diag([1.0, 1.0, -1.0, 1.0])
    looking[:3, 3] = [0, -1, -4]
    trial["camera"] = (looking, trial["camera"][1])
    trial["positions"][:] = [[0, 1, 0], [1, 2, 0], [0, 1, -9]]
    pivots = read(tmp_path / "pivots", trial)
    projected = pivots.image_positions[0]
    np.testing.assert_allclose(projected[0], [24, 16])
    # The point is 1 to the right, 1 up and 4 away; the focal lengths are 1.5 and 2 half images.
    np.testing.assert_allclose(projected[1], [24 * (1 + 3 / 8), 16 * (1 - 1 / 2)], rtol=1e-6)
    assert np.isfinite(projected).all()
    trial["center"] = trial["positions"] + np.float32([0, 0.3, 0])
    trial["center"][:, 2] = np.nan
    centred = read(tmp_path / "centres", trial)
    np.testing.assert_array_equal(centred.positions, pivots.positions)
    moved = centred.image_positions - pivots.image_positions
    assert (moved[:, :2, 1] < -1).all()
    assert not moved[:, 2].any()


def test_an_object_is_in_view_if_its_colour_is_visible(tmp_path: Path) -> None:
    trial = physion_trial()
    trial["hidden"] = {4: (1,), 5: (0, 1, 2)}
    in_view = read(tmp_path, trial).in_view
    assert in_view[3:7].tolist() == [[1, 1, 1], [1, 0, 1], [0, 0, 0], [1, 1, 1]]
    # An object that is never drawn has the colour of the background, black.
    trial["colors"] = COLORS * np.uint8([[1], [1], [0]])
    assert read(tmp_path, trial).in_view.any(axis=0).tolist() == [True, True, False]


def test_a_file_without_velocities_contacts_and_labels_is_read(tmp_path: Path) -> None:
    """Early files lack them, and the objects of Flex trials have no finite velocities."""
    trial = physion_trial()
    trial["positions"][:, 1] += np.outer(np.arange(60), [0.02, 0, 0]).astype(np.float32)
    trial["velocities"] = trial["angular_velocities"] = None
    folder = tmp_path / "early" / "Drape" / "0.hdf5"
    write_physion(folder, trial)
    with h5py.File(folder, "r+") as file:
        for frame in file["frames"].values():
            del frame["collisions"], frame["env_collisions"]
    early = physion.read_scene(folder, folder.parents[1], "test", fps=50)
    trial["velocities"] = np.tile(np.float32([np.nan, 0, 0]), (60, 3, 1))
    flex = read(tmp_path / "flex", trial, fps=50, scenario="Drape")
    for scene in (early, flex):
        np.testing.assert_allclose(scene.velocities[:, 1], np.tile([1, 0, 0], (60, 1)), atol=1e-4)
        assert not scene.velocities[:, [0, 2]].any()
        assert not scene.angular_velocities.any()
        assert (scene.collisions, scene.landings) == ((), ())


def test_the_ramp_of_a_roll_trial_has_its_own_name_and_scale(tmp_path: Path) -> None:
    trial = physion_trial() | {"models": [b"cube", b"sphere", b"ramp_with_platform_30"]}
    trial["scale"] = np.float32([[0.2, 0.2, 0.2], [0.3, 0.3, 0.3], [0.2, 1, 0.5]])
    roll = read(tmp_path / "a", trial, scenario="Roll")
    assert [o.shape for o in roll.objects] == ["cube", "ramp_with_platform_30", "sphere"]
    assert roll.object_radii == pytest.approx((0.1, 0.175, 0.15))
    other = read(tmp_path / "b", trial, scenario="Drop")
    assert [o.shape for o in other.objects] == ["cube", "sphere", "ramp_with_platform_30"]


def test_radii_are_those_of_bounds_scales_or_contacts(tmp_path: Path) -> None:
    trial = physion_trial()
    trial["pairs"][30], trial["states"][30] = [[A, B]], [b"enter"]
    contact = float(np.hypot(1, 1)) / 2  # on the ground, A and B are 1 apart along both axes
    assert read(tmp_path / "contacts", trial).object_radii == pytest.approx((contact,) * 3)
    trial["scale"] = np.float32([[0.2, 9, 0.4], [0.5, 9, 0.5], [1, 9, 1]])
    assert read(tmp_path / "scales", trial).object_radii == pytest.approx((0.15, 0.25, 0.5))
    for key, axis, sign in (("left", 0, -1), ("right", 0, 1), ("front", 2, 1), ("back", 2, -1)):
        trial[key] = trial["positions"].copy()
        trial[key][:, :2, axis] += np.float32(sign * np.array([0.6, 0.7]))
    assert read(tmp_path / "bounds", trial).object_radii == pytest.approx((0.6, 0.7, 0.5))


# Subtype A1: two objects come into contact.


def add_contact(trial: dict, first: int, last: int, pair: list[int], enters: bool = True) -> None:
    """Add a contact of a pair from frame `first` to `last`, and its exit in the next frame.

    With `enters=False`, the contact has begun before `first`.
    """
    for frame in range(first, last + 2):
        state = b"enter" if enters and frame == first else b"stay" if frame <= last else b"exit"
        trial["pairs"][frame].append(pair)
        trial["states"][frame].append(state)


def test_every_contact_of_a_pair_is_a_collision(tmp_path: Path) -> None:
    trial = physion_trial()
    add_contact(trial, 20, 24, [C, A])
    add_contact(trial, 50, 54, [A, C])
    add_contact(trial, 22, 30, [B, C])
    add_contact(trial, 25, 26, [A, 99])
    add_contact(trial, 28, 29, [B, B])
    found = read(tmp_path, trial).collisions
    assert found == (
        Collision(20, (0, 2), 24),
        Collision(22, (1, 2), 30),
        Collision(50, (0, 2), 54),
    )


def test_pairs_in_contact_from_the_start_have_no_first_collision(tmp_path: Path) -> None:
    for enters in (True, False):
        trial = physion_trial()
        add_contact(trial, 0, 10, [A, B], enters)
        add_contact(trial, 40, 45, [B, A])
        add_contact(trial, 43, 45, [B, C])
        scene = read(tmp_path, trial)
        contacts = Collision(0, (0, 1), 10), Collision(40, (0, 1), 45), Collision(43, (1, 2), 45)
        assert scene.collisions == contacts
        assert first_collisions(scene) == [contacts[2]]
        assert collision_frames(scene) == [40, 43]
    # The simulation may start after the first frame, so contacts of objects at rest may be listed
    # from a later frame on, in files without states.
    trial = physion_trial()
    add_contact(trial, 1, 50, [A, B])
    add_contact(trial, 20, 22, [B, C])
    scene = read(tmp_path, trial, states=False)
    contacts = Collision(0, (0, 1), 51), Collision(20, (1, 2), 23)
    assert scene.collisions == contacts
    assert first_collisions(scene) == [contacts[1]]


# Subtype A2: an object at rest begins to move.


ONSETS = {
    "slow": (lambda f: np.maximum(f - 20, 0) * 0.004, [(23, 1)]),
    "sudden": (lambda f: 0.02 * (f >= 30), [(30, 1)]),
    "jitter": (lambda f: 0.004 * (f % 2), []),
    "a return": (lambda f: 0.5 * ((f == 20) | (f == 21)), []),
    "no rest": (lambda f: 0.003 * f, []),
    "too late": (lambda f: 0.5 * (f >= 58), []),
}


def test_a_motion_onset_is_the_first_frame_away_from_rest(tmp_path: Path) -> None:
    scene = read(tmp_path, physion_trial())
    for motion, (offset, onsets) in ONSETS.items():
        positions = scene.positions.copy()
        positions[:, 1, 0] += offset(np.arange(60))
        assert find_motion_onsets(replace(scene, positions=positions)) == onsets, motion


# Subtype A3: an object lands.

UP, SIDE = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)


def test_a_landing_is_the_first_floor_contact_after_a_flight(tmp_path: Path) -> None:
    trial = physion_trial()
    for frame in range(60):
        if frame >= 25:
            trial["environment"][frame].append(A)
            trial["points"][frame].append((UP, (-1.1, 0.0, 0.0)))
        if frame not in range(30, 50):
            trial["environment"][frame].append(C)
            trial["points"][frame].append((UP, (1.1, 0.001, 0.0)))
    # The object bounces: it loses contact for one frame.
    trial["environment"][27], trial["points"][27] = [], []
    assert read(tmp_path, trial).landings == (Landing(25, 0), Landing(50, 2))
    # Any contact ends a flight.
    trial = physion_trial()
    add_contact(trial, 20, 28, [A, B])
    for frame in (31, 40):
        trial["environment"][frame], trial["points"][frame] = [A], [(UP, (-1.0, 0.0, 0.0))]
    assert read(tmp_path, trial).landings == (Landing(40, 0),)


def test_walls_shelves_and_ceilings_are_not_the_ground(tmp_path: Path) -> None:
    """A point is assigned to the nearest object: A touches the floor while C touches a wall."""
    trial = physion_trial()
    shelf, ceiling = (UP, (-1.0, 0.4, 0.0)), ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0))
    for frame, point in ((10, (SIDE, (-1.0, 0.0, 0.0))), (20, shelf), (30, ceiling)):
        trial["environment"][frame], trial["points"][frame] = [A], [point]
    trial["environment"][40] = [C, A]
    trial["points"][40] = [(SIDE, (1.2, 0.9, 0.0)), (UP, (-0.9, 0.0, 0.1))]
    assert read(tmp_path, trial).landings == (Landing(40, 0),)


# Refused files


def replace_dataset(path: str, data: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[path]
        file.create_dataset(path, data=data)

    return change


POSITIONS = "frames/0007/objects/positions"
DEFECTS: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "a frame rate of zero": (
        lambda file: file["static"].create_dataset("framerate", data=0),
        "static/framerate",
    ),
    "a rotation without a direction": (
        replace_dataset("frames/0007/objects/rotations", np.zeros((3, 4))),
        "frame 7: the quaternion of object 0",
    ),
    "one model name": (replace_dataset("static/model_names", b"bowl"), "1 models"),
    "two objects of one id": (replace_dataset("static/object_ids", [3, 3, 4]), "the id 3"),
    "no image": (lambda file: file.__delitem__("frames/0007/images/_img"), "0007/images/_img"),
    "a missing frame": (lambda file: file.__delitem__("frames/0007"), "0007"),
    "one object too few": (replace_dataset(POSITIONS, np.zeros((2, 3))), "(3, 3)"),
    "NaN positions": (replace_dataset(POSITIONS, np.full((3, 3), np.nan)), "positions"),
    "half a pair": (
        replace_dataset("frames/0007/collisions/object_ids", [3]),
        "collisions/object_ids",
    ),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_trial_without_the_published_layout_is_refused(tmp_path: Path, defect: str) -> None:
    change, named = DEFECTS[defect]
    path = write_physion(tmp_path / "roll" / "0000.hdf5", physion_trial(12))
    with h5py.File(path, "r+") as file:
        change(file)
    with raises_user_error("invalid-record", contains=(str(path), named)):
        physion.read_scene(path, tmp_path, "test")


def test_files_that_are_cut_off_or_damaged_are_refused(tmp_path: Path) -> None:
    path = write_physion(tmp_path / "roll" / "0000.hdf5", physion_trial(12))
    whole = path.read_bytes()
    with h5py.File(path) as file:
        address = h5py.h5o.get_info(file["frames/0007"].id).addr
    damaged = [whole[: int(kept * len(whole))] for kept in (0, 0.3, 0.99)]
    # h5py raises a KeyError for an object whose header is overwritten.
    damaged.append(whole[:address] + b"\xff" * 16 + whole[address + 16 :])
    for content in damaged:
        path.write_bytes(content)
        with raises_user_error("damaged-file", contains="0000.hdf5"):
            physion.read_scene(path, tmp_path, "test")


def test_the_scenario_is_in_the_path_or_the_stimulus_name(tmp_path: Path) -> None:
    for folder, stimulus, scenario in (
        ("pilot_towers_nb2_fr015", "", "Support"),
        ("0", "pilot_it2_rollingSliding_simple_collision_box_0017", "Roll"),
        ("controllers", "pilot_linking_nl1-8", "Link"),
        ("clothSagging", "", "Drape"),
    ):
        path = tmp_path / folder / "0000.hdf5"
        write_physion(path, {**physion_trial(12), "stimulus_name": stimulus})
        scene = physion.read_scene(path, tmp_path, "test")
        assert (scene.scenario, scene.scene_id) == (scenario, f"physion-{scenario}-{folder}_0000")
    path = write_physion(tmp_path / "0" / "0.hdf5", {**physion_trial(12), "stimulus_name": "x"})
    with raises_user_error("invalid-record", contains="Dominoes"):
        physion.read_scene(path, tmp_path, "test")
