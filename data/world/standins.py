"""Stand-ins: Bullet scenes that imitate the motions of MoVi-A and Physion.

They replace a transfer suite whose release is not available. Their items are built in the same way
as those of the suite. They measure how a student transfers to unseen motions, light and cameras.
Results on them are not results on the paper's suites, so they have names of their own,
`standin_movi_a` and `standin_physion`.

In the stand-in of MoVi-A, objects fall and bounce for two seconds. In that of Physion, objects rest
until another object slides into them or falls on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from data.records import Scene, SceneObject
from data.world.camera import STANDARD_VIEW, Camera, View
from data.world.physics import GENERATOR_VERSION, Body, Physics, shared_simulator
from data.world.sampling import is_on_screen, record_scene, sample_objects, unit_vector
from data.world.shapes import RADIUS

if TYPE_CHECKING:
    from conf.schema import BenchmarkConfig

STANDINS_VERSION = "2"
"""Increment it whenever the scenes or the appearance of a stand-in change."""

ROW_STEP = (0.75, 1.1)
"""Range of distances between neighbours in a row of objects, simulator units."""

Start = tuple[str, list[Body]]
"""The name of a scenario, and the initial bodies."""


@dataclass(frozen=True)
class Standin:
    """How the scenes of a stand-in are simulated and viewed."""

    frames: int
    """Frames per scene."""
    physics: Physics
    view: View
    start: Callable[[list[SceneObject], View, np.random.Generator], Start | None]
    """Samples the initial states of the given objects, or returns None if a sampled
    position is off screen."""


def thrown(objects: list[SceneObject], view: View, rng: np.random.Generator) -> Start | None:
    """Sample objects in the air that move towards the middle of the view."""
    bodies = []
    for each in objects:
        place = rng.uniform([-1.5, -1.6], [0.9, 1.6])
        height = rng.uniform(0.5, 1.5)
        if not is_on_screen(place, height, view.camera):
            return None
        toward = rng.uniform(-0.5, 0.5, 2) - place
        velocity = rng.uniform(0.6, 1.6) * toward / np.linalg.norm(toward)
        bodies.append(Body(each, place, rng.uniform(0, np.pi), velocity, height))
    return "", bodies


def struck(objects: list[SceneObject], view: View, rng: np.random.Generator) -> Start | None:
    """Sample a row of objects at rest, and an object that strikes the first object of the row.

    The striking object slides along the row (scenario Collide) or falls (scenario Drop).
    """
    last, *row = objects
    # The row is roughly perpendicular to the view: otherwise objects would hide each other.
    bearing = rng.choice([-1, 1]) * np.pi / 2 + rng.uniform(-0.7, 0.7)
    place = rng.uniform([-0.8, -1.0], [1.0, 1.0])
    first, bodies = place, []
    for each in row:
        if not is_on_screen(place, RADIUS, view.camera):
            return None
        bodies.append(Body(each, place, rng.uniform(0, np.pi)))
        place = place + rng.uniform(*ROW_STEP) * unit_vector(bearing + rng.normal(0, 0.15))
    if rng.random() < 0.5:
        start = first - rng.uniform(1.5, 3.0) * unit_vector(bearing + rng.normal(0, 0.05))
        velocity = first - start
        velocity *= rng.uniform(1.5, 3.0) / np.linalg.norm(velocity)
        bodies.append(Body(last, start, rng.uniform(0, np.pi), velocity))
        return "Collide", bodies
    start = first + rng.normal(0, 0.25, 2)
    height = rng.uniform(0.9, 1.6)
    if not is_on_screen(start, height, view.camera):
        return None
    velocity = rng.uniform(0.2, 0.8) * unit_vector(rng.uniform(0, 2 * np.pi))
    bodies.append(Body(last, start, rng.uniform(0, np.pi), velocity, height))
    return "Drop", bodies


STANDINS = {
    "movi_a": Standin(
        frames=24,
        physics=Physics(
            fps=12, substeps=15, gravity=6.0, ground_friction=0.6, object_friction=0.4,
            ground_restitution=0.9, rubber_restitution=0.8, metal_restitution=0.5,
        ),
        view=View(Camera(eye=(3.6, 0.0, 3.5)), (184.0, 188.0, 194.0), (-3.0, 4.0, 7.0)),
        start=thrown,
    ),
    "physion": Standin(
        frames=150,
        physics=Physics(fps=30, substeps=6, gravity=4.0, metal_restitution=0.4),
        view=View(Camera(eye=(4.5, 0.0, 2.0)), (176.0, 148.0, 112.0), (4.0, -4.0, 5.0)),
        start=struck,
    ),
}  # fmt: skip
"""Stand-ins by the suite that they imitate, whose frame rate they have. Gravity is weaker than on
Earth, so that some objects are still in the air when a prefix ends."""


def generator_version(standin: str | None) -> str:
    """Return the version of the code that simulates a benchmark's scenes."""
    return GENERATOR_VERSION + (f", stand-ins {STANDINS_VERSION}" if standin else "")


def standin_view(standin: str | None) -> View:
    """Return the camera, floor and light of a stand-in, or the standard ones without a stand-in."""
    return STANDINS[standin].view if standin else STANDARD_VIEW


def simulate_standin(name: str, index: int, split: str, cfg: BenchmarkConfig) -> Scene:
    """Simulate scene `index` of the benchmark's stand-in. The same index and settings give the same
    scene.

    A scene without a collision, or with objects that touch at the start, is sampled again.
    """
    standin = STANDINS[cfg.standin]
    rng = np.random.default_rng([cfg.seed, index])
    while True:
        start = standin.start(sample_objects(rng, cfg), standin.view, rng)
        if start is None:
            continue
        scenario, bodies = start
        motion = shared_simulator().simulate(bodies, standin.frames, standin.physics)
        if motion.collisions and not motion.touching_at_start:
            return record_scene(
                name, split, bodies, motion, standin.physics, standin.view.camera, scenario
            )
