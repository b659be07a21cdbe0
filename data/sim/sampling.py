"""Samples the scenes of a world.

A scene depends only on the seed, its index, the world and the version of the generator.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import product

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.conf.schema import WorldConfig
from dynapix.data.records import COLORS, MATERIALS, SceneObject
from dynapix.data.sim import starts
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.physics import Body
from dynapix.data.sim.starts import RejectedError, Sample

STARTS = {"slide": starts.slide, "throw": starts.throw, "strike": starts.strike}
"""Functions that sample the initial states of objects, by `start.kind` of the world."""
ATTEMPTS = 300
"""Number of samples after which a world is refused because none was suitable."""
MIN_PART_DEPTH = 0.3
"""Minimum depth (simulator units) of a part, which the renderer cannot clip."""
MIN_CORNER_HEIGHT = -0.05
"""Minimum height (simulator units) of a part's corners."""
MIN_CENTRE_HEIGHT = -0.1
"""Height (simulator units) below which a centre has fallen through the floor."""

TOO_MANY = "objects collide too often"
FALLEN = "an object falls through the floor"
REMEDIES: Mapping[str, str] = {
    starts.OFF_SCREEN: "change start.area, or camera.position, camera.aim or camera.field_of_view",
    starts.OVERLAP: "lower objects.scale or objects.max_count, enlarge start.area or start.height, "
    "or move the parts",
    starts.NO_COLLISION: "raise start.speed, lower start.spread, or lower the friction in physics",
    starts.NO_PLACE: "lower objects.scale or objects.max_count, raise start.speed, or move the "
    "camera or the parts",
    TOO_MANY: "raise start.max_collisions or set it to null",
    FALLEN: "raise physics.substeps, or lower start.speed, start.height or physics.gravity",
}
"""What to change in the world, by the reason for which most samples were rejected."""


def sample_scene(world: WorldConfig, seed: int, index: int) -> Sample:
    """Sample scene `index` of a world: its bodies and their motion.

    Raises:
        UserError: the camera does not see `start.middle`; a part is not entirely in front of the
            camera and above the floor; or no suitable scene was found, and the message names the
            most frequent reason.
    """
    camera = Camera.from_settings(world.camera)
    check_view(world, camera)
    rng = np.random.default_rng([seed, index])
    rejections: Counter[str] = Counter()
    for _ in range(ATTEMPTS):
        try:
            sample = STARTS[world.start.kind](sample_objects(rng, world), world, camera, rng)
            check_sample(sample, world)
        except RejectedError as rejection:
            rejections[str(rejection)] += 1
        else:
            return sample
    ((reason, count),) = rejections.most_common(1)
    raise UserError(
        f"world {world.name}: scene {index} was sampled {ATTEMPTS} times without success; in "
        f"{count} samples, {reason}: {REMEDIES[reason]} (settings of benchmark.world)",
        code="impossible-world",
    )


def check_view(world: WorldConfig, camera: Camera) -> None:
    """Raises UserError if the camera does not see `start.middle`, or if a part is not entirely in
    front of the camera and above the floor."""
    problems, start = [], world.start
    if start.kind != "strike" and not starts.is_on_screen(np.array(start.middle), 0.0, camera):
        problems.append(
            f"the camera does not see benchmark.world.start.middle={start.middle}: change "
            f"benchmark.world.camera.aim={world.camera.aim} or benchmark.world.camera.position"
        )
    for name, box in zip(world.parts, world_boxes(world), strict=True):
        part, lowest = f"benchmark.world.parts.{name}", box.corners[:, 2].min()
        if camera.project(box.corners)[1].min() < MIN_PART_DEPTH:
            problems.append(f"{part} is not entirely in front of the camera: move it or the camera")
        elif lowest < MIN_CORNER_HEIGHT:
            problems.append(
                f"{part} reaches {-lowest:.2f} below the floor, where it would be drawn over it: "
                "raise the z of its position"
            )
    if problems:
        raise UserError(f"world {world.name}: {problems[0]}", code="impossible-world")


def sample_objects(rng: np.random.Generator, world: WorldConfig) -> list[Body]:
    """Sample the number of objects in a scene, their distinct appearances and their sizes. The
    bodies have no places yet."""
    settings = world.objects
    every = [SceneObject(*each) for each in product(settings.shapes, MATERIALS, COLORS)]
    count = int(rng.integers(settings.min_count, settings.max_count + 1))
    chosen = [every[k] for k in rng.choice(len(every), count, replace=False)]
    low, high = settings.scale
    scales = rng.uniform(low, high, count).tolist() if low < high else [low] * count
    return [Body(each, scale=scale) for each, scale in zip(chosen, scales, strict=True)]


def check_sample(sample: Sample, world: WorldConfig) -> None:
    """Raises RejectedError if a scene is unsuitable, whatever its start."""
    motion, most = sample.motion, world.start.max_collisions
    if motion.touching_at_start:
        raise RejectedError(starts.OVERLAP)
    # Objects that fall through the floor often miss all others, so that this is checked before the
    # collisions. NaN counts as fallen.
    if not (motion.positions[..., 2] > MIN_CENTRE_HEIGHT).all():
        raise RejectedError(FALLEN)
    if not motion.touching:
        raise RejectedError(starts.NO_COLLISION)
    if most is not None and len(motion.touching) > most:
        raise RejectedError(TOO_MANY)
