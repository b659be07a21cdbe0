"""Laws of motion in random worlds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import pytest

from dynapix.conf.schema import PartConfig, PhysicsConfig, WorldConfig
from dynapix.conf.schema.world import ByMaterial, CameraConfig, ObjectsConfig, StartConfig
from dynapix.data.oracle import visibility
from dynapix.data.records import Scene, SceneObject
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.physics import Body, shared_simulator
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sim.shapes import BOUNDING_RADIUS, CUBE_HALF, RADIUS, half_height, rotation_matrix
from dynapix.data.sources.scenes import record_scene, simulate_without
from tests.data.simulated import CLEVRER, simulate_scene

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
        parts=dict(random_parts(rng, seed)),
    )


def random_parts(rng: np.random.Generator, seed: int) -> Iterator[tuple[str, PartConfig]]:
    """No part, a wall, a ramp, or both, for four seeds in a row."""
    if seed % 2:
        place = [*rng.uniform([-1.7, -0.5], [-1.1, 0.5]), 0.3]
        yield "wall", PartConfig(place, [0.15, 1.5, 0.6], turn=rng.uniform(-40, 40))
    if seed % 4 > 1:
        tilt, side = rng.uniform(8, 35), rng.choice([-0.8, 0.8]).item()
        height = 0.7 * np.sin(np.radians(tilt)).item()
        turn = rng.uniform(-180, 180)
        yield "ramp", PartConfig([-0.4, side, height], [1.4, 1.2, 0.1], turn=turn, tilt=tilt)


def test_visibility_is_the_same_if_all_rays_are_cast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays that are left out meet nothing, and objects for which no rays are cast are visible."""
    worlds = [random_world(seed) for seed in range(12)]
    for world in worlds[::3]:
        world.camera.field_of_view = 100.0
    samples = [sample_scene(world, 0, 0) for world in worlds]

    def record() -> list[Scene]:
        return [record_scene("", "train", *each) for each in zip(samples, worlds, strict=True)]

    def all_pairs(centres: np.ndarray, radius: np.ndarray) -> np.ndarray:
        return np.repeat(~np.eye(len(radius), dtype=bool)[None], len(centres), axis=0)

    def whole_image(
        objects: Sequence[SceneObject], positions: np.ndarray, *rest: object
    ) -> tuple[np.ndarray, np.ndarray]:
        low = np.full((*positions.shape[:2], 2), -1.0)
        return low, low + 1000

    scenes = record()
    monkeypatch.setattr(visibility, "_may_hide", all_pairs)
    monkeypatch.setattr(visibility, "_image_bounds", whole_image)
    hidden = 0
    for scene, other in zip(scenes, record(), strict=True):
        assert (scene.in_view == other.in_view).all()
        assert (scene.visible_fraction == other.visible_fraction).all()
        hidden += (scene.in_view & (scene.visible_fraction < 1)).sum()
    assert hidden > 100


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


@pytest.mark.parametrize("seed", range(6))
def test_energy_never_grows(seed: int) -> None:
    world = random_world(seed)
    energy = total_energy(simulate_scene(seed, 0, world), world)
    # Bullet pushes bodies apart that overlap slightly, which adds a little energy.
    assert np.diff(energy).max() < 0.01 * energy[0], np.diff(energy).argmax()
    assert energy[-1] < energy[0] * 1.001


def test_no_object_enters_a_part_or_the_floor() -> None:
    touched = 0
    for seed in (k for k in range(20) if k % 4):
        world = random_world(seed)
        scene = simulate_scene(seed, 0, world)
        for k, scale in enumerate(scene.object_scales):
            inner = half_height(scene.objects[k].shape, scale)
            assert scene.positions[:, k, 2].min() > inner - 0.02, seed
            for box in world_boxes(world):
                local = (scene.positions[:, k] - box.position) @ rotation_matrix(box.quaternion)
                outside = np.linalg.norm(np.maximum(np.abs(local) - box.half, 0), axis=-1)
                assert outside.min() > inner - 0.02, seed
                touched += outside.min() < inner + 0.05
    assert touched > 10


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
def test_collisions_are_recorded_exactly_when_objects_touch(seed: int) -> None:
    """In a contact, two objects are as near as their sizes allow, but for the way that they move in
    a frame. Spheres that come so near are in contact."""
    world = random_world(seed)
    scene = simulate_scene(seed, 0, world)
    speed = np.linalg.norm(scene.velocities, axis=-1).max(axis=0) / world.physics.fps
    sizes = [
        (RADIUS * scale, BOUNDING_RADIUS[each.shape] * scale)
        for each, scale in zip(scene.objects, scene.object_scales, strict=True)
    ]
    for a, b in combinations(range(len(scene.objects)), 2):
        distance = np.linalg.norm(scene.positions[:, a] - scene.positions[:, b], axis=-1)
        step = speed[a] + speed[b]
        own = [(c.frame, c.end) for c in scene.collisions if c.objects == (a, b)]
        for first, last in own:
            assert distance[[first, last]].max() < sizes[a][1] + sizes[b][1] + step
        if own:
            assert distance[: max(own[0][0] - 1, 0)].min(initial=np.inf) > CUBE_HALF
        if scene.objects[a].shape == scene.objects[b].shape == "sphere":
            for frame in np.flatnonzero(distance < sizes[a][0] + sizes[b][0] - 0.005):
                assert any(first - 1 <= frame <= last + 1 for first, last in own)


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("world", [CLEVRER, *map(random_world, range(4))], ids=lambda w: w.name)
def test_removing_an_object_changes_nothing_before_it_is_touched(
    world: WorldConfig, index: int
) -> None:
    sample = sample_scene(world, 1, index)
    factual = record_scene("factual", "train", sample, world)
    for removed in range(len(factual.objects)):
        other = simulate_without("other", "train", sample.bodies, removed, world)
        kept = [k for k in range(len(factual.objects)) if k != removed]
        reached = frames_reached(factual, other, removed, kept)
        for k, original in enumerate(kept):
            until = reached.get(original, factual.frames)
            same = factual.positions[:until, original] == other.positions[:until, k]
            assert same.all(), (removed, original)


def frames_reached(factual: Scene, other: Scene, removed: int, kept: list[int]) -> dict[int, int]:
    """The frame from which the motion of each object may change when one is removed: that of its
    first contact, in either scene, with an object whose motion may have changed. Contacts may last:
    objects that have collided count as touching."""
    collisions = [(c.frame, c.objects) for c in factual.collisions]
    collisions += [(c.frame, tuple(kept[k] for k in c.objects)) for c in other.collisions]
    reached = {removed: 0}
    for _ in factual.objects:
        for frame, pair in collisions:
            for one, two in (pair, pair[::-1]):
                if one in reached:
                    since = max(frame, reached[one])
                    reached[two] = min(since, reached.get(two, since))
    return reached
