"""Stand-ins for transfer suites: falls and bounces, what their cameras see, and their items."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from conf.compose import compose
from conf.errors import UserError
from conf.schema import BenchmarkConfig, BuildCommand, Quota, SelectionConfig
from data.build import check_names, ensure_items
from data.parallel import Workers
from data.records import Scene, SceneObject
from data.render.bullet import OVERSAMPLING, BulletRenderer
from data.render.frame_cache import FrameCache
from data.store import Store
from data.world.events import find_motion_onsets
from data.world.physics import Body, Physics, shared_world
from data.world.shapes import RADIUS
from data.world.standins import STANDINS, simulate_standin

BALL = SceneObject("sphere", "rubber", "red")
SUITES = list(STANDINS)


def kind(suite: str) -> BenchmarkConfig:
    return BenchmarkConfig(name="kind", standin=suite, min_objects=3, max_objects=5)


@pytest.fixture(scope="module", params=SUITES)
def scenes(request: pytest.FixtureRequest) -> tuple[str, list[Scene]]:
    """A stand-in and four scenes of it."""
    cfg = kind(request.param)
    return request.param, [simulate_standin(f"{cfg.standin}-{k}", k, "test", cfg) for k in range(4)]


@pytest.mark.parametrize("gravity", [4.0, 9.81])
def test_a_ball_falls_half_g_t_squared_and_lands_when_it_is_down(gravity: float) -> None:
    physics = Physics(fps=30, substeps=6, gravity=gravity)
    motion = shared_world().simulate([Body(BALL, (0, 0), 0, (0, 0), height=1.5)], 40, physics)
    (landing,) = motion.landings
    seconds = np.sqrt(2 * (1.5 - RADIUS) / gravity)
    assert landing.frame == pytest.approx(np.ceil(seconds * 30), abs=1)
    fall = np.arange(landing.frame) / 30
    expected = 1.5 - gravity * fall**2 / 2
    np.testing.assert_allclose(motion.positions[: landing.frame, 0, 2], expected, atol=0.02)


def test_on_a_livelier_ground_a_ball_bounces_higher_and_on_one_of_0_it_stays() -> None:
    rebounds = []
    for ground in (0.0, 0.5, 0.9):
        physics = Physics(ground_restitution=ground, rubber_restitution=0.8)
        motion = shared_world().simulate([Body(BALL, (0, 0), 0, (0, 0), height=1.0)], 40, physics)
        (landing,) = motion.landings
        rebounds.append(motion.positions[landing.frame + 1 :, 0, 2].max() - RADIUS)
    none, some, more = rebounds
    assert none == pytest.approx(0, abs=0.01)
    assert none + 0.02 < some < more - 0.02
    assert more < 1.0 - RADIUS


def test_what_stands_on_the_ground_does_not_land() -> None:
    motion = shared_world().simulate([Body(BALL, (0, 0), 0, (1.0, 0))], 10)
    assert motion.landings == ()


def test_a_scene_follows_from_its_seed_and_index(scenes: tuple[str, list[Scene]]) -> None:
    suite, found = scenes
    again = simulate_standin("again", 2, "test", kind(suite))
    assert (again.objects, again.collisions) == (found[2].objects, found[2].collisions)
    np.testing.assert_array_equal(again.positions, found[2].positions)
    assert len({s.objects for s in found}) == len(found)


def test_scenes_are_of_the_length_and_events_of_their_suite(
    scenes: tuple[str, list[Scene]],
) -> None:
    suite, found = scenes
    frames, fps = (24, 12) if suite == "movi_a" else (150, 30)
    assert {(s.frames, s.fps) for s in found} == {(frames, fps)}
    for scene in found:
        assert scene.collisions
        assert scene.scenario in (("",) if suite == "movi_a" else ("Collide", "Drop"))
        if suite == "movi_a":
            assert (scene.positions[0, :, 2] > RADIUS).all()
        elif scene.scenario == "Collide":
            assert find_motion_onsets(scene)
            assert scene.landings == ()


def test_objects_are_drawn_where_the_oracle_has_them(scenes: tuple[str, list[Scene]]) -> None:
    suite, found = scenes
    drawn = BulletRenderer(480, 320, STANDINS[suite].view)
    seen = 0
    for scene in found:
        handles = drawn.pose(scene, 8)
        _, mask = drawn.photograph()
        for k, handle in enumerate(handles):
            rows, columns = np.nonzero(mask == handle)
            place = scene.image_positions[8, k]
            whole = scene.visible_fraction[8, k] == 1 and (place > 40).all()
            if whole and (place < np.array([440, 280])).all():
                centre = np.array([columns.mean(), rows.mean()]) / OVERSAMPLING
                np.testing.assert_allclose(centre, place, atol=4)
                seen += 1
    assert seen > 3


@pytest.fixture(scope="module", params=SUITES)
def store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """The preset with fewer scenes and items."""
    cfg = compose("data.build", BuildCommand, [f"benchmark=standin_{request.param}"]).benchmark
    cfg.scenes = 30
    for quotas in (cfg.selection.event, cfg.selection.time):
        for quota in quotas.values():
            quota.test = 2
    return ensure_items(cfg, tmp_path_factory.mktemp("store"), Workers(1))


def test_a_stand_in_is_named_so_and_is_for_testing_alone(store: Store) -> None:
    items = store.selection()
    assert {i.suite for i in items} == {store.name} == {store.suite}
    assert store.suite.startswith("standin_")
    assert {i.split for i in items} == {"test"}
    assert all(name.startswith(f"{store.suite}-") for name in store.scene_ids("test"))
    config = store.manifest["config"]["selection"]
    assert len(items) == 2 * (len(config["event"]) + len(config["time"]))
    same = 1 if store.suite == "standin_movi_a" else 2
    for item in items:
        wrong = [c for c in item.candidates if c.source != "target"]
        assert sum(c.scene_id == item.scene_id for c in wrong) == same


def test_a_stand_ins_frames_are_of_its_own_view(store: Store) -> None:
    cache, name = FrameCache.of(store), store.scene_ids("test")[0]
    own = cache.draw(name, [3])[3]
    view = STANDINS[store.suite.removeprefix("standin_")].view
    np.testing.assert_array_equal(own, BulletRenderer(192, 128, view).render(store.scene(name), 3))
    standard = replace(cache, standin=None).draw(name, [3])[3]
    floor, other = (np.median(pixels, axis=(0, 1)) for pixels in (own, standard))
    assert np.abs(floor - other).max() > 20


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"standin": "clevrer"}, "benchmark.standin=clevrer: the options are movi_a, physion"),
        ({"standin": "movi_a", "simulator": "physion"}, "benchmark.simulator=physion"),
        ({"standin": "physion", "max_objects": 7}, "benchmark.max_objects=7"),
        ({"standin": "movi_a", "renderer": "blender"}, "benchmark.renderer=bullet or egl"),
    ],
)
def test_what_cannot_stand_in_is_a_sentence(changes: dict[str, str], said: str) -> None:
    (problem,) = BenchmarkConfig(name="wrong", **changes).check()
    assert said in problem


def test_a_stand_in_has_no_counterfactual_scenes() -> None:
    cfg = kind("physion")
    cfg.retrieval.counterfactual = Quota(train=0, test=4)
    (problem,) = cfg.check()
    assert "benchmark.retrieval.counterfactual" in problem


def test_a_family_that_a_suite_does_not_have_is_named() -> None:
    window = SelectionConfig(window={"G1_A_h8_easy": Quota(test=1)})
    with pytest.raises(UserError, match=r"selection\.window: suite standin_movi_a has no items"):
        check_names(replace(kind("movi_a"), selection=window))
