"""Velocities of every release agree with its positions, or are scaled, derived or refused."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynapix.data.records import FPS, Collision, Scene
from dynapix.data.sources import clevrer, movi_a, physion
from dynapix.data.sources.validation import (
    MIN_FRAMES,
    RescaledVelocities,
    compare_velocities,
    reconcile_velocities,
)
from dynapix.data.store import load_scene, save_scene
from tests.data.sources.clevrer_files import clevrer_annotation, write_clevrer_scene
from tests.data.sources.movi_a_files import movi_example, write_movi_folder
from tests.data.sources.physion_files import physion_trial, write_physion
from tests.teacher import synthetic
from tests.user_errors import raises_user_error

PATH = Path("scene.json")


@pytest.fixture
def scene() -> Scene:
    """Two objects that collide and one at rest."""
    made = synthetic.scene([(-1, 0), (1, 0), (0, 1)], [(0.6, 0.1), (-0.4, 0), (0, 0)])
    turned = np.zeros_like(made.velocities)
    turned[:, 0, 2] = 0.1
    return replace(made, angular_velocities=turned)


def scaled(scene: Scene, factor: float) -> Scene:
    return replace(
        scene,
        velocities=scene.velocities * factor,
        angular_velocities=scene.angular_velocities * factor,
    )


def turns(axis: int, angles: np.ndarray) -> np.ndarray:
    """Quaternions (F, 4) of turns about a coordinate axis."""
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, axis], quaternions[:, 3] = np.sin(angles / 2), np.cos(angles / 2)
    return quaternions


def test_velocities_that_agree_are_kept(scene: Scene) -> None:
    """Also beside contacts, with rounded positions, and up to a tenth of difference."""
    rng = np.random.default_rng(0)
    noisy = replace(scene, positions=scene.positions + rng.normal(0, 1e-4, scene.positions.shape))
    for given in (scene, noisy, scaled(scene, 1.05)):
        with warnings.catch_warnings(action="error"):
            kept = reconcile_velocities(given, PATH)
        np.testing.assert_allclose(kept.velocities, given.velocities, rtol=1e-6)
        np.testing.assert_allclose(kept.angular_velocities, given.angular_velocities, rtol=1e-6)


@pytest.mark.parametrize("factor", [0.3, 100 / 30])
def test_velocities_of_another_unit_of_time_are_scaled(scene: Scene, factor: float) -> None:
    with pytest.warns(RescaledVelocities) as caught:
        found = reconcile_velocities(scaled(scene, 1 / factor), PATH)
    assert caught[0].message.factor == pytest.approx(factor, rel=1e-3)
    np.testing.assert_allclose(found.velocities, scene.velocities, rtol=1e-3)
    np.testing.assert_allclose(found.angular_velocities, scene.angular_velocities, rtol=1e-3)
    # Lengths may be in any unit, and the axes may point anywhere.
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    changed = replace(
        scene,
        positions=4 * scene.positions @ turn + 7,
        velocities=4 * scene.velocities @ turn,
        fps=scene.fps * factor,
    )
    assert compare_velocities(changed)[0] == pytest.approx(factor)


DISAGREEMENTS = {
    "no displacements": lambda s: replace(s, positions=s.positions[:1] + 0 * s.positions),
    "opposite velocities": lambda s: replace(s, velocities=-s.velocities),
    "swapped axes": lambda s: replace(s, velocities=s.velocities[..., [2, 1, 0]]),
    "one object of another unit": lambda s: replace(
        s, velocities=s.velocities * np.array([1, 3, 1])[:, None]
    ),
}


@pytest.mark.parametrize("disagreement", DISAGREEMENTS)
def test_velocities_that_no_factor_explains_are_refused(scene: Scene, disagreement: str) -> None:
    with raises_user_error(
        "inconsistent-velocities", contains=("scene.json", "velocities", "benchmark.fps")
    ):
        reconcile_velocities(DISAGREEMENTS[disagreement](scene), PATH)


def test_jumps_of_velocity_at_contacts_are_no_disagreement(scene: Scene) -> None:
    positions, velocities = scene.positions.copy(), scene.velocities.copy()
    positions[60:, 1] = positions[60, 1] - (positions[60:, 1] - positions[60, 1])
    velocities[60:, 1] *= -1
    bounce = replace(
        scene, positions=positions, velocities=velocities, collisions=(Collision(60, (1, 2), 60),)
    )
    factor, deviations = compare_velocities(bounce)
    assert factor == pytest.approx(1)
    assert deviations == pytest.approx(0, abs=1e-6)


def test_objects_at_rest_or_seen_for_a_few_frames_are_not_compared(scene: Scene) -> None:
    rng = np.random.default_rng(3)
    resting = replace(
        scene,
        positions=scene.positions[:1] + rng.normal(0, 1e-4, scene.positions.shape),
        velocities=rng.normal(0, 0.02, scene.velocities.shape),
    )
    short = {name: getattr(scene, name)[: MIN_FRAMES // 2] for name in Scene.ARRAYS}
    for given in (resting, replace(scaled(scene, 9), **short)):
        factor, deviations = compare_velocities(given)
        assert (factor, deviations.any()) == (1.0, np.False_)


def test_rolling_about_a_pivot_off_the_centre_is_not_compared(scene: Scene) -> None:
    """Physion's positions are those of pivots, which circle around the centre of a rolling ball."""
    angles = np.arange(scene.frames) * 0.6 / FPS / 0.2
    positions, quaternions = scene.positions.copy(), scene.quaternions.copy()
    positions[:, 0] += 0.2 * np.stack([-np.sin(angles), 0 * angles, -np.cos(angles)], -1)
    quaternions[:, 0] = turns(1, angles)
    rolling = replace(scene, positions=positions, quaternions=quaternions)
    factor, deviations = compare_velocities(rolling)
    assert (factor, deviations[0]) == (pytest.approx(1), 0)


def test_velocities_that_are_not_recorded_are_derived(scene: Scene) -> None:
    """Those of one object do not concern the others, which keep or scale theirs. Zero velocities of
    an object that moves are not recorded ones."""
    quaternions = scene.quaternions.copy()
    quaternions[:, 0] = turns(2, 0.5 * np.arange(scene.frames) / FPS)
    given = replace(scaled(scene, 0.1), quaternions=quaternions)
    given.velocities[5, 0, 1] = np.nan
    given.angular_velocities[5, 0, 0] = np.inf
    with pytest.warns(RescaledVelocities):
        found = reconcile_velocities(given, PATH)
    np.testing.assert_allclose(found.velocities, scene.velocities, atol=1e-4)
    spin = np.tile([0, 0, 0.5], (128, 1))
    np.testing.assert_allclose(found.angular_velocities[:, 0], spin, atol=1e-4)
    zero = scene.velocities.copy()
    zero[:, 1] = 0
    found = reconcile_velocities(replace(scene, velocities=zero), PATH)
    np.testing.assert_allclose(found.velocities, scene.velocities, atol=1e-4)


def read_clevrer(folder: Path, factor: float) -> Scene:
    record = clevrer_annotation()
    for moment in record["motion_trajectory"]:
        for state in moment["objects"]:
            state["orientation"] = [0.0, 0.0, 0.0]  # as in the release, spheres slide
            state["velocity"] = [factor * v for v in state["velocity"]]
    path, _ = write_clevrer_scene(folder, record)
    return clevrer.read_scene(path, folder, "test")


def read_movi_a(folder: Path, factor: float) -> Scene:
    example = movi_example()
    example["velocities"] *= factor
    path = write_movi_folder(folder / "00012", example)
    return movi_a.read_scene(path, folder, "test")


def read_physion(folder: Path, factor: float) -> Scene:
    trial = physion_trial()
    trial["positions"][:, 0, 0] += np.arange(60) / 30
    trial["velocities"][:, 0, 0] = factor
    path = write_physion(folder / "Drop" / "0.hdf5", trial)
    return physion.read_scene(path, folder, "test", fps=30)


@pytest.mark.parametrize("read", [read_clevrer, read_movi_a, read_physion])
def test_every_reader_compares_velocities_with_positions(read, tmp_path: Path) -> None:
    with warnings.catch_warnings(action="error"):
        expected = read(tmp_path / "right", 1.0)
    with pytest.warns(RescaledVelocities):
        found = read(tmp_path / "scaled", 3.0)
    np.testing.assert_allclose(found.velocities, expected.velocities, rtol=5e-3, atol=1e-6)
    with raises_user_error("inconsistent-velocities"):
        read(tmp_path / "reversed", -1.0)


def test_a_stored_scene_keeps_what_differs_from_the_standard(tmp_path: Path) -> None:
    """Default values are not recorded, so that the bytes of other scenes do not depend on them."""
    scene = read_clevrer(tmp_path, 1.0)
    tracked = {"records_contacts": False, "speed_bounds": (0.2, 0.5, 1.0)}
    for given in (replace(scene, **tracked), replace(scene, radii=(), scales=())):
        save_scene(given, path := tmp_path / "scene.npz")
        loaded = load_scene(path)
        for name in ("object_radii", "object_scales", "records_contacts", "speed_bounds"):
            assert getattr(loaded, name) == getattr(given, name)
        np.testing.assert_array_equal(loaded.velocities, given.velocities)
        with np.load(path) as file:
            header = json.loads(str(file["header"]))
        assert ("radii" in header) == ("records_contacts" in header) == bool(given.radii)
