"""Frames of a scene by OpenGL: Bullet's EGL plugin, for machines whose driver draws without a
window.

It draws what the rasteriser draws: the same meshes, poses, camera, light and floor. Its pixels
depend on the driver: they are alike, not equal, from machine to machine.
"""

from __future__ import annotations

import atexit
import importlib.util
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.errors import UserError
from data.records import SHAPES, Scene, SceneObject
from data.render.appearance import STANDARD_VIEW, View, mesh
from data.render.bullet import OVERSAMPLING, BulletRenderer, save_textures
from data.world.physics import connect, silence

if TYPE_CHECKING:
    from pybullet_utils.bullet_client import BulletClient

VERSION = "egl-1"

WINDOW = (1024, 768)
"""What the plugin draws into, px; more it would only enlarge."""


def start() -> BulletClient:
    """A Bullet client with the EGL plugin, proved by a first picture."""
    bullet = connect()
    plugin = importlib.util.find_spec("eglRenderer")
    if plugin is None or bullet.loadPlugin(plugin.origin, "_eglRendererPlugin") < 0:
        sys.exit("this pybullet comes without eglRenderer")
    for _ in range(2):  # the second is the last to print a greeting
        bullet.getCameraImage(8, 8, renderer=bullet.ER_BULLET_HARDWARE_OPENGL)
    return bullet


@cache
def _stage() -> tuple[BulletClient, Path]:
    """This process's client, and the folder of its meshes. A second one would disturb the first."""
    # Kept to the end, for Bullet reads a mesh's file whenever a body is made of it.
    folder = tempfile.TemporaryDirectory(prefix="dynapix-egl-")
    _save_meshes(Path(folder.name))
    with silence(1), silence(2):
        bullet = start()
    atexit.register(_end, bullet, folder)
    return bullet, Path(folder.name)


def _end(bullet: BulletClient, folder: tempfile.TemporaryDirectory) -> None:
    """Close a client without its farewell on the screen."""
    with silence(1):
        bullet.disconnect()
    folder.cleanup()


class EglRenderer(BulletRenderer):
    """Draws frames of any scene at one size, through OpenGL, without a window."""

    version = VERSION
    _on_stage: EglRenderer | None = None
    """Whose scene stands in the process's client."""

    def __init__(self, width: int, height: int, view: View = STANDARD_VIEW) -> None:
        """Raises UserError where the plugin cannot draw so large a frame."""
        if width * OVERSAMPLING > WINDOW[0] or height * OVERSAMPLING > WINDOW[1]:
            raise UserError(
                f"renderer=egl draws frames of {WINDOW[0] // OVERSAMPLING} x "
                f"{WINDOW[1] // OVERSAMPLING} px at most, you ask for {width} x {height}: make "
                "them smaller, or use renderer=bullet"
            )
        super().__init__(width, height, view)

    def pose(self, scene: Scene, frame: int) -> list[int]:
        before = EglRenderer._on_stage
        if before is not None and before is not self:
            before._clear()
        EglRenderer._on_stage = self
        return super().pose(scene, frame)

    @staticmethod
    @cache
    def check() -> None:
        """Raises UserError where no driver draws without a window."""
        # Without one Bullet ends its whole process, so that another has to try.
        code = "from data.render.egl import start; start()"
        tried = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        if tried.returncode != 0:
            words = tried.stderr.strip().splitlines() or [f"status {tried.returncode}"]
            raise UserError(
                "renderer=egl needs a graphics driver that draws without a window, and none could "
                f"be started ({words[-1]}): install the driver with its EGL library, or use "
                "renderer=bullet"
            )

    def _connect(self) -> tuple[BulletClient, int]:
        bullet, self._folder = _stage()
        return bullet, bullet.ER_BULLET_HARDWARE_OPENGL

    def _add(self, look: SceneObject) -> int:
        return self._new_body(look)  # its mesh brings its texture

    def _mesh(self, look: SceneObject) -> dict[str, Any]:
        return {"fileName": str(self._folder / f"{look.material}-{look.shape}.obj")}


def _save_meshes(folder: Path) -> None:
    """Write every shape in every material as an .obj file with its texture: the plugin takes no
    mesh from memory, and does not change the texture of one."""
    for material, picture in save_textures(folder).items():
        (folder / f"{material}.mtl").write_text(f"newmtl {material}\nmap_Kd {picture.name}\n")
        for shape in SHAPES:
            vertices, normals, uvs, triangles = mesh(shape)
            lines = [f"mtllib {material}.mtl", f"usemtl {material}"]
            lines += [f"v {x} {y} {z}" for x, y, z in vertices]
            lines += [f"vt {u} {v}" for u, v in uvs]
            lines += [f"vn {x} {y} {z}" for x, y, z in normals]
            lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in triangles + 1]
            (folder / f"{material}-{shape}.obj").write_text("\n".join(lines) + "\n")
