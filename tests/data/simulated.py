"""Scenes that tests simulate, within the default limits on objects and collisions."""

from __future__ import annotations

from conf.schema import BenchmarkConfig
from data.records import Scene
from data.world.sampling import format_scene_id, record_scene, sample_bodies

LIMITS = BenchmarkConfig(name="limits")


def simulate_scene(seed: int, index: int) -> Scene:
    """Simulate scene `index` of a seed; it is a training scene."""
    bodies, motion = sample_bodies(seed, index, LIMITS)
    return record_scene(format_scene_id(seed, index), "train", bodies, motion)
