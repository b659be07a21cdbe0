"""Scenes that tests simulate, by default in the world of CLEVRER."""

from __future__ import annotations

from dynapix.conf.compose import compose
from dynapix.conf.schema import BuildCommand, WorldConfig
from dynapix.data.records import Scene
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sources.scenes import record_scene

CLEVRER = WorldConfig()
WORLDS = [
    "above", "above_masses", "clevrer", "dusk", "falling", "masses", "movi_a", "near", "physion",
    "ramp", "screen", "settling",
]  # fmt: skip
"""Names of the presets in conf/world."""


def preset_world(name: str) -> WorldConfig:
    """The world of a preset in conf/world."""
    recipe = f"standin_{name}" if name in ("movi_a", "physion") else "tiny"
    return compose(
        "data.build", BuildCommand, [f"benchmark={recipe}", f"world={name}"]
    ).benchmark.world


def simulate_scene(seed: int, index: int, world: WorldConfig = CLEVRER) -> Scene:
    """Simulate scene `index` of a seed; it is a training scene."""
    sample = sample_scene(world, seed, index)
    return record_scene(f"s{seed}-{index:06d}", "train", sample, world)
