"""Scenes and their pixels agree in every world."""

from __future__ import annotations

import numpy as np
import pytest

from dynapix.conf.schema import WorldConfig
from dynapix.conf.schema.world import CameraConfig
from dynapix.data.records import Scene, SceneObject
from dynapix.data.render.bullet import OVERSAMPLING, BulletRenderer
from dynapix.data.sim.physics import Body, shared_simulator
from dynapix.data.sim.starts import Sample
from dynapix.data.sources.scenes import record_scene
from tests.data.oracle.test_random_worlds import random_world
from tests.data.simulated import WORLDS, preset_world, simulate_scene


@pytest.mark.parametrize("seed", range(6))
def test_oracle_matches_the_drawn_objects_in_random_worlds(seed: int) -> None:
    """Centres lie on the drawn objects, and visible fractions equal those of the drawn pixels."""
    world = random_world(seed)
    check_pixels(simulate_scene(seed, 2, world), world, (0, 30, 59))


@pytest.mark.parametrize("name", WORLDS)
def test_oracle_matches_the_drawn_objects_of_presets(name: str) -> None:
    world = preset_world(name)
    check_pixels(simulate_scene(5, 0, world), world, (0, 11, 23))


def check_pixels(scene: Scene, world: WorldConfig, frames: tuple[int, ...]) -> None:
    renderer = BulletRenderer(480, 320, world)
    checked = 0
    for frame in frames:
        handles = renderer.pose(scene, frame)
        _, together = renderer.capture()
        for k, handle in enumerate(handles):
            rows, columns = np.nonzero(together == handle)
            position, fraction = scene.image_positions[frame, k], scene.visible_fraction[frame, k]
            is_inside = (position > 60).all() and (position < np.array([420, 260])).all()
            if is_inside and fraction == 1:
                centre = np.array([columns.mean(), rows.mean()]) / OVERSAMPLING
                np.testing.assert_allclose(centre, position, atol=6)
                checked += 1
            if is_inside:
                alone = pixels_alone(renderer, scene, frame, k)
                assert len(rows) / alone == pytest.approx(fraction, abs=0.04)
    assert checked > 0


def pixels_alone(renderer: BulletRenderer, scene: Scene, frame: int, index: int) -> int:
    """The number of pixels that an object would cover if nothing hid it."""
    handles = renderer.pose(scene, frame)
    far = [100.0, 100.0, 0.0]
    for k, handle in enumerate(handles):
        if k != index:
            renderer._bullet.resetBasePositionAndOrientation(handle, far, [0, 0, 0, 1])
    return int((renderer._draw()[2] == handles[index]).sum())


def test_background_is_drawn_above_the_horizon() -> None:
    camera = CameraConfig([4.0, 0.0, 1.0], [0.0, 0.0, 0.9])
    world = WorldConfig(camera=camera, background=[10.0, 200.0, 30.0])
    body = Body(SceneObject("sphere", "rubber", "red"), (0.0, 0.0), 0)
    sample = Sample([body], shared_simulator().simulate([body], world, frames=1))
    scene = record_scene("one", "train", sample, world)
    pixels = np.asarray(BulletRenderer(96, 64, world).render(scene, 0))
    np.testing.assert_array_equal(pixels[0, 0], [10, 200, 30])
    assert pixels[-1, 0, 1] < 190
