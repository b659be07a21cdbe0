"""Versions of the code that determines the scenes, the pixels, the items and the queries.

A benchmark records the versions with which it was built, and a benchmark of other versions is
refused. Increase a version when a change gives other results for the same settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SIMULATOR = "4"
"""Version of the simulated scenes."""
ROLLING = "2"
"""Version of the scenes of worlds with rolling friction; a change of it concerns these alone."""
READERS = {"clevrer": "3", "movi_a": "3", "physion": "3", "tracks": "2"}
"""Versions of the readers of other simulators' releases."""
RENDERERS = {"bullet": "bullet-1", "blender": "blender-1, bpy 4.2.23, 32 samples"}
"""Versions of the renderers. Blender gives other pixels with another release or more samples."""
BUILDERS = {"paper": "9", "balanced": "11", "contact": "2"}
"""Versions of the items and queries, by the recipe of the distractors."""
INTERVENTIONS = "1"
"""Version of items about interventions; a change of it concerns benchmarks with them alone."""


def component_versions(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of the code that determines a benchmark with these settings."""
    simulator = config["simulator"]
    if simulator == "bullet":
        rolls = config["world"]["physics"]["rolling_friction"]
        generator = f"{SIMULATOR}.{ROLLING}" if rolls else SIMULATOR
        renderer = RENDERERS[config["renderer"]]
    else:
        generator = f"{simulator}-{READERS[simulator]}"
        renderer = f"{simulator}'s own frames"
    builders = BUILDERS[config["distractors"]]
    if config["selection"].get("interventions"):
        builders = f"{builders}.{INTERVENTIONS}"
    return {"generator": generator, "renderer": renderer, "builders": builders}
