"""Renderer with OpenGL: Bullet's EGL plugin, for machines with a headless graphics driver.

Meshes, poses, camera, light and floor equal those of the `bullet` renderer. Pixels depend on the
driver, so they differ slightly between machines.
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
"""Size of the plugin's frame buffer in px; it would enlarge larger images."""


def start() -> BulletClient:
    """Connect a Bullet client with the EGL plugin and render a test image."""
    bullet = connect()
    plugin = importlib.util.find_spec("eglRenderer")
    if plugin is None or bullet.loadPlugin(plugin.origin, "_eglRendererPlugin") < 0:
        sys.exit("this build of pybullet lacks eglRenderer")
    for _ in range(2):  # the plugin prints messages during the first two
        bullet.getCameraImage(8, 8, renderer=bullet.ER_BULLET_HARDWARE_OPENGL)
    return bullet


@cache
def _shared_client() -> tuple[BulletClient, Path]:
    """The client of this process and the folder of its meshes; two clients would interfere."""
    # Kept until exit, because Bullet reads a mesh's file whenever it creates a body.
    folder = tempfile.TemporaryDirectory(prefix="dynapix-egl-")
    _save_meshes(Path(folder.name))
    with silence(1), silence(2):
        bullet = start()
    atexit.register(_disconnect, bullet, folder)
    return bullet, Path(folder.name)


def _disconnect(bullet: BulletClient, folder: tempfile.TemporaryDirectory) -> None:
    """Disconnect a client without its console output."""
    with silence(1):
        bullet.disconnect()
    folder.cleanup()


class EglRenderer(BulletRenderer):
    """Renders frames of any scene at one size with OpenGL, without a window."""

    version = VERSION
    _active: EglRenderer | None = None
    """The renderer whose objects are in the shared client."""

    def __init__(self, width: int, height: int, view: View = STANDARD_VIEW) -> None:
        """Raises UserError for frames larger than the plugin supports."""
        if width * OVERSAMPLING > WINDOW[0] or height * OVERSAMPLING > WINDOW[1]:
            raise UserError(
                f"renderer=egl supports frames of at most {WINDOW[0] // OVERSAMPLING} x "
                f"{WINDOW[1] // OVERSAMPLING} px, not {width} x {height}: use a smaller size, or "
                "renderer=bullet",
                code="frame-too-large",
            )
        super().__init__(width, height, view)

    def pose(self, scene: Scene, frame: int) -> list[int]:
        previous = EglRenderer._active
        if previous is not None and previous is not self:
            previous._clear()
        EglRenderer._active = self
        return super().pose(scene, frame)

    @staticmethod
    @cache
    def check() -> None:
        """Raises UserError where no driver can render without a window."""
        # Bullet exits without one, so the check runs in a separate process.
        code = "from data.render.egl import start; start()"
        attempt = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        if attempt.returncode != 0:
            lines = attempt.stderr.strip().splitlines() or [f"status {attempt.returncode}"]
            raise UserError(
                "renderer=egl needs a graphics driver that renders without a window, and none "
                f"starts ({lines[-1]}): install the driver with its EGL library, or use "
                "renderer=bullet",
                code="missing-driver",
            )

    def _connect(self) -> tuple[BulletClient, int]:
        bullet, self._folder = _shared_client()
        return bullet, bullet.ER_BULLET_HARDWARE_OPENGL

    def _add(self, look: SceneObject) -> int:
        return self._new_body(look)  # its mesh file includes the texture

    def _mesh(self, look: SceneObject) -> dict[str, Any]:
        return {"fileName": str(self._folder / f"{look.material}-{look.shape}.obj")}


def _save_meshes(folder: Path) -> None:
    """Write each shape in each material as an .obj file with its texture, because the plugin can
    neither take meshes from memory nor change their textures."""
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
