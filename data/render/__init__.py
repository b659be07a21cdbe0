"""The two renderers of scenes, `bullet` and `blender`, which have the same interface.

`bullet` runs on every machine, and `blender` renders images in the style of CLEVRER's videos. The
renderer is a setting of a benchmark, because the two give different pixels. `render(scene, frame)`
returns an RGB image.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from dynapix.data.render.blender import BlenderRenderer
from dynapix.data.render.bullet import BulletRenderer

Renderer = BulletRenderer | BlenderRenderer
RENDERERS: dict[str, type[Renderer]] = {"bullet": BulletRenderer, "blender": BlenderRenderer}


def get_renderer(config: Mapping[str, Any]) -> Renderer:
    """Return this process's renderer for the settings of a benchmark: the renderer's name, the
    frame size and the world.

    Raises:
        UserError: the renderer cannot run on this machine.
    """
    return _make_renderer(
        config["renderer"], config["width"], config["height"], json.dumps(config["world"])
    )


@cache
def _make_renderer(name: str, width: int, height: int, world: str) -> Renderer:
    from dynapix.conf.schema.settings import from_dict
    from dynapix.conf.schema.world import WorldConfig

    return RENDERERS[name](width, height, from_dict(WorldConfig, json.loads(world)))
