"""Worlds: presets, stand-ins, items in every world, and bad worlds."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dynapix.conf.compose import compose
from dynapix.conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    PartConfig,
    PhysicsConfig,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
    WorldConfig,
)
from dynapix.conf.schema.benchmark import SCENE_FPS, SCENE_FRAMES
from dynapix.conf.schema.world import (
    SLIDE_FRAMES,
    CameraConfig,
    LightConfig,
    ObjectsConfig,
    StartConfig,
)
from dynapix.data.build import check_quota_names, ensure_items, world_changes
from dynapix.data.frames.frame_cache import render_frames
from dynapix.data.oracle.events import find_motion_onsets, group_contacts
from dynapix.data.parallel import Workers
from dynapix.data.records import FPS, FRAMES, SPEED_BOUNDS, SceneObject
from dynapix.data.render.bullet import BulletRenderer
from dynapix.data.sim import starts as sliding
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.physics import Body, shared_simulator
from dynapix.data.sim.sampling import FALLEN, REMEDIES, check_sample, sample_scene
from dynapix.data.sim.shapes import RADIUS
from dynapix.data.sim.starts import RejectedError
from dynapix.data.store import Store
from dynapix.data.versions import component_versions
from dynapix.teacher.predicates.extraction import extract_predicates
from tests.conftest import micro_config
from tests.data.sim.test_physics import fingerprint
from tests.data.simulated import WORLDS, preset_world, simulate_scene
from tests.user_errors import raises_user_error

COUNTERFACTUALS = RetrievalTrackConfig(counterfactual=Quota(test=4))


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_scene_is_a_function_of_seed_and_index(name: str) -> None:
    world = preset_world(name)
    scenes = [simulate_scene(0, k, world) for k in (0, 1, 0)]
    assert fingerprint(scenes[0]) == fingerprint(scenes[2]) != fingerprint(scenes[1])
    assert {(s.frames, s.fps) for s in scenes} == {(world.physics.frames, world.physics.fps)}


@pytest.mark.slow
def test_presets_have_the_motions_that_they_are_named_after() -> None:
    falling, ramp, settling, screen = (
        [simulate_scene(1, k, preset_world(name)) for k in range(count)]
        for name, count in (("falling", 5), ("ramp", 5), ("settling", 5), ("screen", 12))
    )
    assert sum(len(s.landings) for s in falling) > 12
    assert any(s.landings and s.positions[0, :, 2].max() > 0.4 for s in ramp)
    at_rest = [np.linalg.norm(s.velocities[-1], axis=-1) < 0.05 for s in settling]
    assert np.concatenate(at_rest).mean() > 0.75
    hidden = [(s.visible_fraction < 0.05) & s.in_view for s in screen]
    reappears = [h[:-1] & ~h[1:] for h in hidden]
    assert sum(bool(r.any()) for r in reappears) >= 4


def test_near_magnifies_objects_twofold() -> None:
    near, standard = (Camera.from_settings(preset_world(n).camera) for n in ("near", "clevrer"))
    assert near.magnification == pytest.approx(2 * standard.magnification, rel=1e-3)


def test_metal_pushes_rubber_away_in_the_world_of_masses() -> None:
    """The striking sphere goes on if it is the heavier one, and comes back if it is the lighter."""
    world = preset_world("masses")
    for striking, resting in (("metal", "rubber"), ("rubber", "metal")):
        bodies = [
            Body(SceneObject("sphere", striking, "red"), (0.0, -1.0), 0, (0.0, 2.0)),
            Body(SceneObject("sphere", resting, "blue"), (0.0, 0.0), 0),
        ]
        motion = shared_simulator().simulate(bodies, world, frames=30)
        (hit,) = group_contacts(motion.touching, FPS)
        before, after = (motion.velocities[hit.frame + k, 0, 1] for k in (-1, 1))
        assert (after > before / 3) == (striking == "metal")


def test_dusk_has_the_scenes_of_the_standard_world_in_less_light() -> None:
    dusk, standard = (simulate_scene(0, 3, preset_world(name)) for name in ("dusk", "clevrer"))
    np.testing.assert_array_equal(dusk.positions, standard.positions)
    dark, bright = (
        BulletRenderer(192, 128, preset_world(name)).render(scene, 10)
        for name, scene in (("dusk", dusk), ("clevrer", standard))
    )
    assert np.mean(dark) < np.mean(bright) - 30


@pytest.mark.parametrize("suite", ["movi_a", "physion"])
def test_stand_ins_match_the_length_and_events_of_their_suite(suite: str) -> None:
    scenes = [simulate_scene(0, k, preset_world(suite)) for k in range(4)]
    frames, fps = (24, 12) if suite == "movi_a" else (150, 30)
    assert {(s.frames, s.fps) for s in scenes} == {(frames, fps)}
    for scene in scenes:
        assert scene.collisions
        assert scene.scenario in (("",) if suite == "movi_a" else ("Collide", "Drop"))
        if suite == "movi_a":
            assert (scene.positions[0, :, 2] > RADIUS).all()
        elif scene.scenario == "Collide":
            assert find_motion_onsets(scene)
            assert scene.landings == ()


@pytest.fixture(
    scope="module", params=["above", "falling", "masses", "near", "ramp", "screen", "settling"]
)
def world_store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A small benchmark of the recipe dynapix in another world, with all kinds of records."""
    command = compose("data.build", BuildCommand, ["benchmark=tiny", f"world={request.param}"])
    cfg = command.benchmark
    cfg.scenes = 30
    tracks = cfg.selection, cfg.retrieval
    quotas = [*tracks[0].event.values(), *tracks[0].time.values(), *tracks[0].window.values()]
    for quota in (*quotas, *tracks[1].builders.values(), tracks[1].counterfactual):
        quota.train, quota.test = 0, min(quota.test, 1)
    cfg.selection.matched.test = 1
    cfg.retrieval = replace(cfg.retrieval, database=30, source=40, counterfactual_source=10)
    return ensure_items(cfg, tmp_path_factory.mktemp("store"), Workers(1))


@pytest.mark.slow
def test_every_builder_and_the_predicates_work_in_every_world(world_store: Store) -> None:
    world = world_store.manifest["config"]["world"]["name"]
    assert world_store.name == f"tiny-{world}"
    items = world_store.selection()
    assert {i.family for i in items} == {"event", "time", "window"}
    assert all(i.scene_id.startswith(f"{world}-") for i in items)
    assert {q.builder for q in world_store.retrieval()} == {1, 2, 3, 4, 5, 6}
    assert world_store.retrieval(pool="counterfactual")
    facts = [extract_predicates(i, world_store.scene(i.scene_id), world_store.scene) for i in items]
    assert sum(f is not None for f in facts) > len(facts) / 3
    assert all(f.answer == i.letter for f, i in zip(facts, items, strict=True) if f)


def test_identity_contains_the_world_unless_it_is_the_standard_one() -> None:
    store = Store(Path(), {"config": asdict(micro_config()), "renderer": "", "files": {}})
    identities = set()
    for name in ("clevrer", "above", "dusk"):
        changes = world_changes(preset_world(name))
        assert changes.get("name", "clevrer") == name
        manifest = store.manifest | {"world_changes": changes}
        identities.add(replace(store, manifest=manifest).identity)
    assert world_changes(preset_world("clevrer")) == {}
    assert len(identities) == 3


def test_rolling_friction_has_a_version_of_its_own() -> None:
    """A change of rolling friction leaves the benchmarks of other worlds valid."""
    versions = {
        name: component_versions(asdict(micro_config(world=preset_world(name))))["generator"]
        for name in WORLDS
    }
    assert versions["settling"].startswith(f"{versions['clevrer']}.")
    assert {v for name, v in versions.items() if name != "settling"} == {versions["clevrer"]}


@pytest.mark.parametrize(
    ("index", "collisions", "last_places"),
    [
        (0, [45, 60], [[-0.6318, -1.6439], [-0.9185, -0.7244], [-2.3619, -2.2223],
                       [-2.7528, -2.2490], [0.4133, 1.2634], [-1.3834, 1.3038]]),
        (1, [12, 89], [[-0.1486, -1.8600], [-0.8891, -1.1464], [-0.9602, -0.4050],
                       [0.1618, 0.2448], [1.1275, -0.4233]]),
    ],
)  # fmt: skip
def test_scenes_of_the_standard_world_never_change(
    index: int, collisions: list[int], last_places: list[list[float]]
) -> None:
    """Benchmarks of the world clevrer can be built again only if its scenes stay the same."""
    scene = simulate_scene(0, index)
    assert [c.frame for c in scene.collisions] == collisions
    np.testing.assert_allclose(scene.positions[-1, :, :2], last_places, atol=1.1e-4)


@pytest.fixture(scope="module", params=["movi_a", "physion"])
def standin(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A benchmark of the preset's stand-in, with fewer scenes and items than the preset."""
    cfg = compose("data.build", BuildCommand, [f"benchmark=standin_{request.param}"]).benchmark
    cfg.scenes = 30
    for quotas in (cfg.selection.event, cfg.selection.time):
        for quota in quotas.values():
            quota.test = 2
    return ensure_items(cfg, tmp_path_factory.mktemp("store"), Workers(1))


@pytest.mark.slow
def test_standin_has_its_own_suite_and_only_test_items(standin: Store) -> None:
    items = standin.selection()
    assert {i.suite for i in items} == {standin.name} == {standin.suite}
    assert standin.suite.startswith("standin_")
    assert {i.split for i in items} == {"test"}
    assert all(name.startswith(f"{standin.suite}-") for name in standin.scene_ids("test"))
    config = standin.manifest["config"]["selection"]
    assert len(items) == 2 * (len(config["event"]) + len(config["time"]))


@pytest.mark.slow
def test_frames_have_the_light_and_floor_of_their_world(standin: Store) -> None:
    scene, config = standin.scene(standin.scene_ids("test")[0]), standin.manifest["config"]
    own = render_frames(scene, [3], config)[3]
    world = preset_world(standin.suite.removeprefix("standin_"))
    np.testing.assert_array_equal(own, BulletRenderer(192, 128, world).render(scene, 3))
    other_world = config["world"] | {"floor": WorldConfig().floor}
    standard = render_frames(scene, [3], config | {"world": other_world})[3]
    floor, other = (np.median(pixels, axis=(0, 1)) for pixels in (own, standard))
    assert np.abs(floor - other).max() > 20


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "key"),
    [
        (
            {"camera": CameraConfig([4.0, 0.0, 2.0], [8.0, 0.0, 0.0])},
            "camera does not see benchmark.world.start.middle",
        ),
        ({"objects": ObjectsConfig(scale=[9.0, 9.0])}, "overlaps no other"),
        (
            {
                "start": StartConfig(
                    kind="throw", area=[-0.05, -0.05, 0.05, 0.05], height=[0.3, 0.4], at_rest=0.0
                )
            },
            "objects overlap at the start: lower objects.scale or objects.max_count, enlarge start",
        ),
        ({"start": StartConfig(kind="strike", area=[8.0, 8.0, 9.0, 9.0])}, "outside the image"),
        ({"start": StartConfig(speed=[0.0, 0.01], at_rest=0.0)}, "start.speed"),
        (
            {"parts": {"wall": PartConfig([4.0, 0.0, 2.0])}},
            "benchmark.world.parts.wall",
        ),
        (
            {"parts": {"wall": PartConfig([-1.0, 0.0, 0.2])}},
            "benchmark.world.parts.wall reaches 0.30 below the floor",
        ),
        (
            {
                "physics": PhysicsConfig(substeps=1, gravity=900.0),
                "objects": ObjectsConfig(min_count=2, max_count=2),
                "start": StartConfig(
                    kind="throw", area=[-1.5, -1.2, 0.2, 1.2], height=[0.5, 1.0], at_rest=0.0
                ),
            },
            "falls through the floor: raise physics.substeps",
        ),
    ],
)
def test_world_without_suitable_scenes_is_refused(world: dict[str, Any], key: str) -> None:
    with raises_user_error("impossible-world", contains=key):
        sample_scene(WorldConfig(name="bad", **world), 0, 0)


def test_object_that_enters_inside_a_part_is_sampled_again() -> None:
    """Its motion ends at the first frame, so that no other object could be placed by it."""
    parts = {"wall": PartConfig([-0.7, 3.3, 0.45], [4.0, 1.0, 0.9])}
    sample = sample_scene(WorldConfig(name="walled", parts=parts), 0, 3)
    assert len(sample.motion.states) == FRAMES


@pytest.mark.parametrize("height", [-0.2, np.nan])
def test_scene_with_an_object_below_the_floor_is_rejected(height: float) -> None:
    sample = sample_scene(WorldConfig(), 0, 0)
    states = sample.motion.states.copy()
    check_sample(sample, WorldConfig())
    states[-1, 0, 2] = height
    with pytest.raises(RejectedError, match=FALLEN):
        check_sample(replace(sample, motion=replace(sample.motion, states=states)), WorldConfig())
    assert "physics.substeps" in REMEDIES[FALLEN]


def test_world_whose_objects_are_all_hidden_is_refused(tmp_path: Path) -> None:
    wall = PartConfig([3.0, 0.0, 1.5], [0.1, 6.0, 3.0])
    cfg = BenchmarkConfig(
        name="hidden", scenes=4, world=WorldConfig("hidden", parts={"wall": wall})
    )
    with raises_user_error("impossible-world", contains="benchmark.world.parts"):
        ensure_items(cfg, tmp_path, Workers(1))


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"recipe": "clevrer"}, "benchmark.recipe=clevrer"),
        ({"simulator": "physion", "recipe": "movi_a"}, "benchmark.recipe=physion"),
        ({"simulator": "clevrer", "world": WorldConfig("dusk")}, "world=clevrer"),
        ({"world": WorldConfig(start=StartConfig(kind="strike"),
                               objects=ObjectsConfig(max_count=7))}, "objects.max_count=7"),
        ({"world": WorldConfig(floor=[1.0, 2.0, 3.0]), "renderer": "blender"}, "floor colour"),
        ({"recipe": "movi_a", "retrieval": COUNTERFACTUALS}, "retrieval.counterfactual"),
        ({"recipe": "movi_a", "distractors": "balanced"}, "distractors=balanced"),
        ({"simulator": "clevrer", "distractors": "balanced"}, "distractors=balanced"),
        ({"world": WorldConfig(physics=PhysicsConfig(fps=30))}, "world.physics.fps=30"),
        ({"world": WorldConfig(parts={"ramp": PartConfig(tilt=60.0)})}, "world.parts.ramp.tilt=60"),
        ({"world": WorldConfig(camera=CameraConfig([1.0, 0.0, -1.0]))}, "not above the floor"),
        ({"world": WorldConfig(camera=CameraConfig([0.0, 0.0, 3.0]))}, "straight down"),
        ({"world": WorldConfig(camera=CameraConfig([3.0, 0.0, 2.0], [0.0, 0.0, 9.0]))}, "no floor"),
        ({"world": WorldConfig(camera=CameraConfig([3.0, 0.0]))}, "3 numbers"),
        ({"world": WorldConfig(light=LightConfig([1.0, 0.0, 0.0]))}, "light is too low"),
        ({"world": WorldConfig(objects=ObjectsConfig(shapes=["cone"]))}, "objects.shapes"),
        ({"world": WorldConfig(objects=ObjectsConfig(max_count=49))}, "max_count=49"),
        ({"world": WorldConfig(objects=ObjectsConfig(scale=[2.0, 1.0]))}, "objects.scale"),
        ({"world": WorldConfig(objects=ObjectsConfig(scale=[]))}, "objects.scale"),
        ({"world": WorldConfig(start=StartConfig(kind="throw", height=[]))}, "start.height"),
    ],
)  # fmt: skip
def test_invalid_world_settings_are_refused(changes: dict[str, Any], key: str) -> None:
    (problem,) = BenchmarkConfig(name="wrong", **changes).check("benchmark.")
    assert key in problem


def test_quota_of_a_family_that_the_suite_lacks_is_refused() -> None:
    window = SelectionConfig(window={"G1_A_h8_easy": Quota(test=1)})
    cfg = compose("data.build", BuildCommand, ["benchmark=standin_movi_a"]).benchmark
    with raises_user_error("unknown-option", contains="benchmark.selection.window"):
        check_quota_names(replace(cfg, selection=window))


def test_limits_of_the_schema_are_those_of_the_simulation() -> None:
    """The schema cannot import the packages that simulate, so that it repeats their constants."""
    assert SLIDE_FRAMES == sliding.EARLIEST + sliding.TAIL + 1
    assert (SCENE_FRAMES, SCENE_FPS) == (FRAMES, FPS)
    assert WorldConfig().speed_bounds == [*SPEED_BOUNDS]
    assert Camera.from_settings(CameraConfig()) == Camera()


def test_camera_projects_its_aim_to_the_middle_of_the_image() -> None:
    camera = Camera.from_settings(CameraConfig([3.0, -2.0, 1.5], [0.5, 0.4, 0.2], 60.0))
    pixel, _ = camera.project(np.array([0.5, 0.4, 0.2]))
    np.testing.assert_allclose(pixel, [240, 160], atol=1e-9)
    edge = camera.rays(np.array([-0.5]), np.array([159.5]))[0]
    forward = camera.axes[2]
    angle = np.arccos(edge @ forward / np.linalg.norm(edge))
    assert np.degrees(angle) == pytest.approx(30.0, abs=0.01)
