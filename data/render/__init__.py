"""The two renderers of scenes, `bullet` and `blender`, which have the same interface.

`bullet` runs on every machine, and `blender` renders images in the style of CLEVRER's videos. The
renderer is a setting of a benchmark, because the two give different pixels. A renderer's `version`
changes whenever the same oracle gives different pixels. `render(scene, frame)` returns an RGB
image.
"""

from __future__ import annotations

from functools import cache

from data.render.blender import BlenderRenderer
from data.render.bullet import BulletRenderer
from data.world.camera import STANDARD_VIEW, View

Renderer = BulletRenderer | BlenderRenderer
RENDERERS: dict[str, type[Renderer]] = {"bullet": BulletRenderer, "blender": BlenderRenderer}


@cache
def get_renderer(name: str, width: int, height: int, view: View = STANDARD_VIEW) -> Renderer:
    """Return this process's renderer for a frame size (px) and a view.

    Raises:
        UserError: the renderer cannot run on this machine.
    """
    return RENDERERS[name](width, height, view)
