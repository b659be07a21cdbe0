"""Renderers of scenes, with one interface.

`bullet` runs on every machine, and `blender` renders images in the style of CLEVRER's videos. The
renderer is a part of a benchmark, because the two give different pixels.
"""

from __future__ import annotations

from functools import cache
from typing import Protocol

from PIL import Image

from data.records import Scene
from data.render import blender, bullet
from data.world.camera import STANDARD_VIEW, View


class Renderer(Protocol):
    """Renders frames of any scene from its oracle, at one size."""

    version: str
    """Changes whenever the same oracle gives different pixels."""

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """Render one frame as an RGB image."""


RENDERERS: dict[str, type[Renderer]] = {
    "bullet": bullet.BulletRenderer,
    "blender": blender.BlenderRenderer,
}


@cache
def get_renderer(name: str, width: int, height: int, view: View = STANDARD_VIEW) -> Renderer:
    """The renderer of this process for a frame size (px) and a view.

    Raises:
        UserError: it cannot run on this machine.
    """
    return RENDERERS[name](width, height, view)
