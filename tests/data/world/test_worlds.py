"""Worlds: laws of motion in random worlds, views, presets, items in every world, and bad worlds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from conf.compose import compose
from conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    PartConfig,
    PhysicsConfig,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
    WorldConfig,
)
from conf.schema.benchmark import SCENE_FPS, SCENE_FRAMES
from conf.schema.world import (
    SLIDE_FRAMES,
    ByMaterial,
    CameraConfig,
    LightConfig,
    ObjectsConfig,
    StartConfig,
)
from data.build import check_quota_names, ensure_items
from data.parallel import Workers
from data.records import FPS, FRAMES, SPEED_BOUNDS, Scene, SceneObject
from data.render.bullet import OVERSAMPLING, BulletRenderer
from data.render.frame_cache import render_frames
from data.store import Store
from data.world import sliding
from data.world.camera import Camera
from data.world.events import find_motion_onsets
from data.world.parts import part_box, surface_height, world_boxes
from data.world.physics import Body, shared_simulator
from data.world.sampling import record_scene, sample_scene, simulate_without
from data.world.shapes import CUBE_HALF, RADIUS, half_height, rotation_matrix
from data.world.starts import Sample
from teacher.predicates import extract_predicates
from tests.data.simulated import preset_world, simulate_scene
from tests.data.world.test_physics import fingerprint, reached_in, touched_by
from tests.user_errors import raises_user_error

BALL = SceneObject("sphere", "rubber", "red")
WORLDS = [
    "clevrer", "dusk", "falling", "masses", "movi_a", "near", "physion", "ramp", "screen",
    "settling",
]  # fmt: skip
COUNTERFACTUALS = RetrievalTrackConfig(counterfactual=Quota(test=4))
ROOM = {
    name: PartConfig(position=place, size=size)
    for name, place, size in [
        ("left", [0.0, -2.0, 0.5], [4.0, 0.1, 1.0]),
        ("right", [0.0, 2.0, 0.5], [4.0, 0.1, 1.0]),
        ("back", [-2.0, 0.0, 0.5], [0.1, 4.0, 1.0]),
        ("front", [2.0, 0.0, 0.5], [0.1, 4.0, 1.0]),
    ]
}


def random_world(seed: int) -> WorldConfig:
    """A world with random physics, objects, camera and parts, and any kind of start."""
    rng = np.random.default_rng(seed)
    kind = ("slide", "throw", "strike")[seed % 3]
    low = rng.uniform(0.7, 1.2)
    parts = {}
    if seed % 2:
        place = [*rng.uniform([-2.6, -0.5], [-2.0, 0.5]), 0.3]
        parts = {"wall": PartConfig(place, [0.15, 1.5, 0.6], turn=rng.uniform(-40, 40))}
    return WorldConfig(
        name=f"random{seed}",
        camera=CameraConfig([rng.uniform(4.2, 5.0), rng.uniform(-1, 1), rng.uniform(2.0, 3.0)]),
        physics=PhysicsConfig(
            frames=60,
            substeps=10,
            gravity=rng.uniform(2, 10),
            floor_friction=rng.uniform(0.05, 0.6),
            object_friction=rng.uniform(0.1, 0.6),
            rolling_friction=rng.choice([0.0, 0.02]).item(),
            floor_restitution=rng.uniform(0, 1),
            restitution=ByMaterial(*rng.uniform(0.2, 1, 2).tolist()),
        ),
        objects=ObjectsConfig(
            min_count=3,
            max_count=4,
            scale=[low, low + rng.uniform(0, 0.4)],
            mass=ByMaterial(*rng.uniform(0.3, 4, 2).tolist()),
        ),
        start=StartConfig(
            kind=kind,
            middle=[-0.2, 0.0],
            at_rest=rng.uniform(0, 0.5),
            area=[-1.5, -1.2, 0.8, 1.2],
            distance=[1.5, 3.0],
            max_collisions=None,
        ),
        parts=parts,
    )


def moments_of_inertia(shape: str, mass: float, scale: float) -> np.ndarray:
    """Moments (3,) about an object's own axes."""
    if shape == "cube":
        return np.full(3, mass * 2 / 3 * (CUBE_HALF * scale) ** 2)
    square = mass * (RADIUS * scale) ** 2
    if shape == "sphere":
        return np.full(3, 2 / 5 * square)
    return square * np.array([7 / 12, 7 / 12, 1 / 2])


def total_energy(scene: Scene, world: WorldConfig) -> np.ndarray:
    """Kinetic and potential energy at each frame, (F,)."""
    energy = np.zeros(scene.frames)
    for k, (each, scale) in enumerate(zip(scene.objects, scene.object_scales, strict=True)):
        mass = getattr(world.objects.mass, each.material) * scale**3
        moments = moments_of_inertia(each.shape, mass, scale)
        for f in range(scene.frames):
            turning = scene.angular_velocities[f, k] @ rotation_matrix(scene.quaternions[f, k])
            energy[f] += mass * (scene.velocities[f, k] ** 2).sum() / 2
            energy[f] += (moments * turning**2).sum() / 2
            energy[f] += mass * world.physics.gravity * scene.positions[f, k, 2]
    return energy


@pytest.mark.parametrize("seed", range(12))
def test_energy_never_grows(seed: int) -> None:
    world = random_world(seed)
    energy = total_energy(simulate_scene(seed, 0, world), world)
    # Bullet pushes bodies apart that overlap slightly, which adds a little energy.
    assert np.diff(energy).max() < 0.01 * energy[0], np.diff(energy).argmax()
    assert energy[-1] < energy[0] * 1.001


@pytest.mark.parametrize("seed", range(12))
def test_no_object_enters_a_part_or_the_floor(seed: int) -> None:
    world = random_world(2 * seed + 1)
    scene = simulate_scene(seed, 0, world)
    (box,) = world_boxes(world)
    for k, scale in enumerate(scene.object_scales):
        local = (scene.positions[:, k] - box.position) @ rotation_matrix(box.quaternion)
        outside = np.linalg.norm(np.maximum(np.abs(local) - box.half, 0), axis=-1)
        inner = half_height(scene.objects[k].shape, scale)
        assert outside.min() > inner - 0.02
        assert scene.positions[:, k, 2].min() > inner - 0.02


def test_fast_objects_stay_in_a_closed_room() -> None:
    world = WorldConfig(
        parts=ROOM, physics=PhysicsConfig(substeps=20, floor_friction=0.0, frames=100)
    )
    colors = ("red", "blue", "green")
    bodies = [
        Body(SceneObject("sphere", "metal", color), (-1.0 + k, 0.8 * k - 0.8), 0.0, (3.0, 3.5 - k))
        for k, color in enumerate(colors)
    ]
    motion = shared_simulator().simulate(bodies, world)
    assert np.linalg.norm(motion.velocities[-1], axis=-1).max() > 0.5
    assert np.abs(motion.positions[..., :2]).max() < 1.95


@pytest.mark.parametrize("seed", range(6))
def test_removing_an_object_changes_nothing_before_it_is_touched(seed: int) -> None:
    world = random_world(seed)
    sample = sample_scene(world, seed, 1)
    factual = record_scene("factual", "train", sample, world)
    for removed in range(len(factual.objects)):
        other = simulate_without("other", "train", sample.bodies, removed, world)
        kept = [k for k in range(len(factual.objects)) if k != removed]
        reached = touched_by(factual, removed)
        for k, original in enumerate(kept):
            until = min(reached.get(original, factual.frames), reached_in(other, k, reached, kept))
            same = factual.positions[:until, original] == other.positions[:until, k]
            assert same.all(), (removed, original)


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
    parts = [renderer._bullet.getBasePositionAndOrientation(k) for k in renderer.part_handles]
    for handle in renderer.part_handles:
        renderer._bullet.resetBasePositionAndOrientation(handle, far, [0, 0, 0, 1])
    _, mask = renderer.capture()
    for handle, (place, turn) in zip(renderer.part_handles, parts, strict=True):
        renderer._bullet.resetBasePositionAndOrientation(handle, place, turn)
    return int((mask == handles[index]).sum())


@pytest.mark.parametrize("gravity", [4.0, 9.81])
def test_sphere_falls_by_half_g_t_squared_and_lands(gravity: float) -> None:
    world = WorldConfig(physics=PhysicsConfig(frames=40, fps=30, substeps=6, gravity=gravity))
    motion = shared_simulator().simulate([Body(BALL, (0, 0), 0, (0, 0), height=1.5)], world)
    (landing,) = motion.landings
    seconds = np.sqrt(2 * (1.5 - RADIUS) / gravity)
    assert landing.frame == pytest.approx(np.ceil(seconds * 30), abs=1)
    fall = np.arange(landing.frame) / 30
    expected = 1.5 - gravity * fall**2 / 2
    np.testing.assert_allclose(motion.positions[: landing.frame, 0, 2], expected, atol=0.02)


def test_rebound_height_grows_with_the_restitution_of_the_floor() -> None:
    rebounds = []
    for floor in (0.0, 0.5, 0.9):
        physics = PhysicsConfig(
            frames=40, floor_restitution=floor, restitution=ByMaterial(rubber=0.8)
        )
        motion = shared_simulator().simulate(
            [Body(BALL, (0, 0), 0, (0, 0), height=1.0)], WorldConfig(physics=physics)
        )
        (landing,) = motion.landings
        rebounds.append(motion.positions[landing.frame + 1 :, 0, 2].max() - RADIUS)
    none, some, more = rebounds
    assert none == pytest.approx(0, abs=0.01)
    assert none + 0.02 < some < more - 0.02
    assert more < 1.0 - RADIUS


def test_object_slides_down_a_ramp_with_the_acceleration_of_its_slope() -> None:
    ramp = PartConfig([0.0, 0.0, 1.0], [8.0, 2.0, 0.1], tilt=20.0, friction=0.5)
    physics = PhysicsConfig(frames=20, object_friction=0.3)
    world = WorldConfig(physics=physics, parts={"ramp": ramp})
    cube = SceneObject("cube", "rubber", "red")
    top = surface_height([part_box(ramp)], np.array([-2.0, 0.0]))
    body = Body(cube, (-2.0, 0.0), 0.0, height=top + 0.3)
    velocities = shared_simulator().simulate([body], world).velocities[:, 0]
    slope = np.radians(20)
    gain = 9.81 * (np.sin(slope) - 0.5 * 0.3 * np.cos(slope))
    speeds = np.linalg.norm(velocities, axis=-1)
    assert (speeds[19] - speeds[9]) * 25 / 10 == pytest.approx(gain, rel=0.1)
    down = velocities[19] / speeds[19]
    np.testing.assert_allclose(down, [np.cos(slope), 0, -np.sin(slope)], atol=0.05)


def test_heavier_object_is_moved_less() -> None:
    speeds = []
    for mass in (0.5, 1.0, 4.0):
        world = WorldConfig(objects=ObjectsConfig(mass=ByMaterial(metal=mass, rubber=1.0)))
        bodies = [
            Body(SceneObject("sphere", "rubber", "red"), (0.0, -1.0), 0, (0.0, 2.0)),
            Body(SceneObject("sphere", "metal", "blue"), (0.0, 0.0), 0),
        ]
        motion = shared_simulator().simulate(bodies, world, frames=30)
        (hit,) = motion.collisions
        speeds.append(motion.velocities[hit.frame + 1, 1, 1])
    assert speeds[0] > speeds[1] + 0.2 > speeds[2] + 0.4


def test_surface_height_follows_a_tilted_part() -> None:
    part = PartConfig([0.0, 0.0, 1.0], [4.0, 2.0, 0.1], turn=90.0, tilt=30.0)
    box = part_box(part)
    slope = np.tan(np.radians(30))
    top = 1.0 + 0.05 / np.cos(np.radians(30))
    for y in (-1.0, 0.0, 1.0):
        # After a turn by 90 degrees, the ramp descends along y.
        assert surface_height([box], np.array([0.3, y])) == pytest.approx(top - slope * y)
    assert surface_height([box], np.array([3.0, 0.0])) == 0


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
        [simulate_scene(1, k, preset_world(name)) for k in range(5)]
        for name in ("falling", "ramp", "settling", "screen")
    )
    assert sum(len(s.landings) for s in falling) > 12
    assert any(s.landings and s.positions[0, :, 2].max() > 0.4 for s in ramp)
    at_rest = [np.linalg.norm(s.velocities[-1], axis=-1) < 0.05 for s in settling]
    assert np.concatenate(at_rest).mean() > 0.75
    hidden = [(s.visible_fraction < 0.05) & s.in_view for s in screen]
    reappears = [h[:-1] & ~h[1:] for h in hidden]
    assert sum(bool(r.any()) for r in reappears) >= 2


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


@pytest.fixture(scope="module", params=["ramp", "screen", "falling"])
def world_store(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A small benchmark of the recipe dynapix in another world, with all kinds of records."""
    command = compose("data.build", BuildCommand, ["benchmark=tiny", f"world={request.param}"])
    cfg = command.benchmark
    cfg.scenes = 40
    tracks = cfg.selection, cfg.retrieval
    quotas = [*tracks[0].event.values(), *tracks[0].time.values(), *tracks[0].window.values()]
    for quota in (*quotas, *tracks[1].builders.values(), tracks[1].counterfactual):
        quota.train, quota.test = 0, min(quota.test, 1)
    cfg.selection.matched.test = 1
    cfg.retrieval = replace(
        cfg.retrieval, standard=4, database=30, source=40, counterfactual_source=10
    )
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


@pytest.mark.slow
def test_identity_contains_the_world(world_store: Store) -> None:
    changed = world_store.manifest | {
        "world_changes": world_store.manifest["world_changes"] | {"gravity": 1.0}
    }
    assert world_store.manifest["world_changes"]["name"] == world_store.name.removeprefix("tiny-")
    assert replace(world_store, manifest=changed).identity != world_store.identity


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


def test_background_is_drawn_above_the_horizon() -> None:
    camera = CameraConfig([4.0, 0.0, 1.0], [0.0, 0.0, 0.9])
    world = WorldConfig(camera=camera, background=[10.0, 200.0, 30.0])
    body = Body(BALL, (0.0, 0.0), 0)
    sample = Sample([body], shared_simulator().simulate([body], world, frames=1))
    scene = record_scene("one", "train", sample, world)
    pixels = np.asarray(BulletRenderer(96, 64, world).render(scene, 0))
    np.testing.assert_array_equal(pixels[0, 0], [10, 200, 30])
    assert pixels[-1, 0, 1] < 190


@pytest.mark.slow
@pytest.mark.parametrize(
    ("world", "key"),
    [
        (
            {"camera": CameraConfig([4.0, 0.0, 2.0], [8.0, 0.0, 0.0])},
            "camera does not see benchmark.world.start.middle",
        ),
        ({"objects": ObjectsConfig(scale=[9.0, 9.0])}, "objects.scale"),
        (
            {"start": StartConfig(kind="throw", area=[-0.2, -0.2, 0.2, 0.2], at_rest=0.0)},
            "start.area",
        ),
        ({"start": StartConfig(kind="strike", area=[8.0, 8.0, 9.0, 9.0])}, "outside the image"),
        ({"start": StartConfig(speed=[0.0, 0.01], at_rest=0.0)}, "start.area"),
        (
            {"parts": {"wall": PartConfig([4.0, 0.0, 2.0])}},
            "benchmark.world.parts.wall",
        ),
    ],
)
def test_world_without_suitable_scenes_is_refused(world: dict[str, Any], key: str) -> None:
    with raises_user_error("impossible-world", contains=key):
        sample_scene(WorldConfig(name="bad", **world), 0, 0)


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
        ({"world": WorldConfig(physics=PhysicsConfig(fps=30))}, "world.physics.fps=30"),
        ({"world": WorldConfig(parts={"ramp": PartConfig(tilt=60.0)})}, "world.parts.ramp.tilt=60"),
        ({"world": WorldConfig(camera=CameraConfig([1.0, 0.0, -1.0]))}, "not above the floor"),
        ({"world": WorldConfig(camera=CameraConfig([0.0, 0.0, 3.0]))}, "straight down"),
        ({"world": WorldConfig(camera=CameraConfig([3.0, 0.0]))}, "3 numbers"),
        ({"world": WorldConfig(light=LightConfig([1.0, 0.0, 0.0]))}, "light is too low"),
        ({"world": WorldConfig(objects=ObjectsConfig(shapes=["cone"]))}, "objects.shapes"),
        ({"world": WorldConfig(objects=ObjectsConfig(max_count=49))}, "max_count=49"),
        ({"world": WorldConfig(objects=ObjectsConfig(scale=[2.0, 1.0]))}, "objects.scale"),
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
