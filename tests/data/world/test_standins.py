"""Stand-ins for transfer suites: falls and bounces, projection, views, items, and settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conf.compose import compose
from conf.schema import BenchmarkConfig, BuildCommand, Quota, RetrievalTrackConfig, SelectionConfig
from data.build import check_quota_names, ensure_items
from data.parallel import Workers
from data.records import Scene, SceneObject
from data.render.bullet import OVERSAMPLING, BulletRenderer
from data.render.frame_cache import render_frames
from data.store import Store
from data.world.events import find_motion_onsets
from data.world.physics import Body, Physics, shared_simulator
from data.world.shapes import RADIUS
from data.world.standins import STANDINS, simulate_standin
from tests.user_errors import raises_user_error

BALL = SceneObject("sphere", "rubber", "red")
SUITES = list(STANDINS)
COUNTERFACTUALS = RetrievalTrackConfig(counterfactual=Quota(test=4))


def standin_config(suite: str) -> BenchmarkConfig:
    return BenchmarkConfig(name="standin", standin=suite, min_objects=3, max_objects=5)


@pytest.fixture(scope="module", params=SUITES)
def scenes(request: pytest.FixtureRequest) -> tuple[str, list[Scene]]:
    """The suite of a stand-in and four of its scenes."""
    cfg = standin_config(request.param)
    return request.param, [simulate_standin(f"{cfg.standin}-{k}", k, "test", cfg) for k in range(4)]


@pytest.mark.parametrize("gravity", [4.0, 9.81])
def test_sphere_falls_by_half_g_t_squared_and_lands(gravity: float) -> None:
    physics = Physics(fps=30, substeps=6, gravity=gravity)
    motion = shared_simulator().simulate([Body(BALL, (0, 0), 0, (0, 0), height=1.5)], 40, physics)
    (landing,) = motion.landings
    seconds = np.sqrt(2 * (1.5 - RADIUS) / gravity)
    assert landing.frame == pytest.approx(np.ceil(seconds * 30), abs=1)
    fall = np.arange(landing.frame) / 30
    expected = 1.5 - gravity * fall**2 / 2
    np.testing.assert_allclose(motion.positions[: landing.frame, 0, 2], expected, atol=0.02)


def test_rebound_height_grows_with_the_restitution_of_the_ground() -> None:
    rebounds = []
    for ground in (0.0, 0.5, 0.9):
        physics = Physics(ground_restitution=ground, rubber_restitution=0.8)
        motion = shared_simulator().simulate(
            [Body(BALL, (0, 0), 0, (0, 0), height=1.0)], 40, physics
        )
        (landing,) = motion.landings
        rebounds.append(motion.positions[landing.frame + 1 :, 0, 2].max() - RADIUS)
    none, some, more = rebounds
    assert none == pytest.approx(0, abs=0.01)
    assert none + 0.02 < some < more - 0.02
    assert more < 1.0 - RADIUS


def test_scene_is_a_function_of_seed_and_index(scenes: tuple[str, list[Scene]]) -> None:
    suite, simulated = scenes
    again = simulate_standin("again", 2, "test", standin_config(suite))
    assert (again.objects, again.collisions) == (simulated[2].objects, simulated[2].collisions)
    np.testing.assert_array_equal(again.positions, simulated[2].positions)
    assert len({s.objects for s in simulated}) == len(simulated)


def test_scenes_match_the_length_and_events_of_their_suite(
    scenes: tuple[str, list[Scene]],
) -> None:
    suite, simulated = scenes
    frames, fps = (24, 12) if suite == "movi_a" else (150, 30)
    assert {(s.frames, s.fps) for s in simulated} == {(frames, fps)}
    for scene in simulated:
        assert scene.collisions
        assert scene.scenario in (("",) if suite == "movi_a" else ("Collide", "Drop"))
        if suite == "movi_a":
            assert (scene.positions[0, :, 2] > RADIUS).all()
        elif scene.scenario == "Collide":
            assert find_motion_onsets(scene)
            assert scene.landings == ()


def test_rendered_objects_are_at_the_oracles_positions(scenes: tuple[str, list[Scene]]) -> None:
    suite, simulated = scenes
    renderer = BulletRenderer(480, 320, STANDINS[suite].view)
    checked = 0
    for scene in simulated:
        handles = renderer.pose(scene, 8)
        _, mask = renderer.capture()
        for k, handle in enumerate(handles):
            rows, columns = np.nonzero(mask == handle)
            position = scene.image_positions[8, k]
            is_whole = scene.visible_fraction[8, k] == 1 and (position > 40).all()
            if is_whole and (position < np.array([440, 280])).all():
                centre = np.array([columns.mean(), rows.mean()]) / OVERSAMPLING
                np.testing.assert_allclose(centre, position, atol=4)
                checked += 1
    assert checked > 3


@pytest.fixture(scope="module", params=SUITES)
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A benchmark of the preset's stand-in, with fewer scenes and items than the preset."""
    cfg = compose("data.build", BuildCommand, [f"benchmark=standin_{request.param}"]).benchmark
    cfg.scenes = 30
    for quotas in (cfg.selection.event, cfg.selection.time):
        for quota in quotas.values():
            quota.test = 2
    return ensure_items(cfg, tmp_path_factory.mktemp("store"), Workers(1))


def test_standin_has_its_own_suite_and_only_test_items(store: Store) -> None:
    items = store.selection()
    assert {i.suite for i in items} == {store.name} == {store.suite}
    assert store.suite.startswith("standin_")
    assert {i.split for i in items} == {"test"}
    assert all(name.startswith(f"{store.suite}-") for name in store.scene_ids("test"))
    config = store.manifest["config"]["selection"]
    assert len(items) == 2 * (len(config["event"]) + len(config["time"]))


def test_standin_frames_have_its_own_view(store: Store) -> None:
    scene, config = store.scene(store.scene_ids("test")[0]), store.manifest["config"]
    own = render_frames(scene, [3], config)[3]
    view = STANDINS[store.suite.removeprefix("standin_")].view
    np.testing.assert_array_equal(own, BulletRenderer(192, 128, view).render(scene, 3))
    standard = render_frames(scene, [3], config | {"standin": None})[3]
    floor, other = (np.median(pixels, axis=(0, 1)) for pixels in (own, standard))
    assert np.abs(floor - other).max() > 20


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"standin": "clevrer"}, "benchmark.standin=clevrer"),
        ({"standin": "movi_a", "simulator": "physion"}, "benchmark.simulator=physion"),
        ({"standin": "physion", "max_objects": 7}, "benchmark.max_objects=7"),
        ({"standin": "movi_a", "renderer": "blender"}, "benchmark.renderer=bullet"),
        ({"standin": "movi_a", "retrieval": COUNTERFACTUALS}, "retrieval.counterfactual"),
    ],
)
def test_invalid_standin_settings_are_refused(changes: dict[str, Any], key: str) -> None:
    (problem,) = BenchmarkConfig(name="wrong", **changes).check("benchmark.")
    assert key in problem


def test_quota_of_a_family_that_the_suite_lacks_is_refused() -> None:
    window = SelectionConfig(window={"G1_A_h8_easy": Quota(test=1)})
    with raises_user_error("unknown-option", contains="benchmark.selection.window"):
        check_quota_names(replace(standin_config("movi_a"), selection=window))
