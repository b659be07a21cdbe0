"""What draws the frames of scenes, behind one interface.

bullet draws everywhere and needs nothing, egl draws the same through a graphics driver, blender
draws what CLEVRER's videos look like. Which one drew a benchmark is part of what it is: the same
oracle has other pixels under another renderer.
"""

from __future__ import annotations

from functools import cache
from typing import Protocol

from PIL import Image

from conf.errors import UserError
from data.records import Scene
from data.render import blender, bullet, egl
from data.render.appearance import STANDARD_VIEW, View


class Renderer(Protocol):
    """Draws frames of any scene from its oracle, all at one size."""

    version: str
    """Changes whenever the same oracle would give other pixels."""

    @staticmethod
    def check() -> None:
        """Raises UserError where this machine lacks what the renderer needs."""

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """One frame as an RGB image of the renderer's size."""


RENDERERS: dict[str, type[Renderer]] = {
    "bullet": bullet.BulletRenderer,
    "egl": egl.EglRenderer,
    "blender": blender.BlenderRenderer,
}


def renderer_version(name: str) -> str:
    """A renderer's version, whether or not it can run here.

    Raises:
        UserError: there is no such renderer.
    """
    if name not in RENDERERS:
        raise UserError(
            f"benchmark.renderer={name}: there is no such renderer, the options are "
            f"{', '.join(RENDERERS)}"
        )
    return RENDERERS[name].version


def check_renderer(name: str) -> None:
    """Find out whether a renderer can run here, before the work that leads up to it.

    Raises:
        UserError: it cannot, for want of a driver or a package, or there is no such renderer.
    """
    renderer_version(name)
    RENDERERS[name].check()


@cache
def get_renderer(name: str, width: int, height: int, view: View = STANDARD_VIEW) -> Renderer:
    """This process's renderer of a name, a frame size (px) and a view.

    Raises:
        UserError: it cannot run here, or there is no such renderer.
    """
    check_renderer(name)
    return RENDERERS[name](width, height, view)
