"""Renderer with Bullet's software rasteriser.

Bullet's TinyRenderer draws the objects as smooth meshes without OpenGL. Metal has a texture that
imitates a reflection, and a sharp highlight; rubber is matt. TinyRenderer can neither clip a large
floor nor soften a shadow, so this module draws the floor and soft shadows wherever no object is.
Objects are rendered at twice the size and averaged, for anti-aliasing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from data.records import MATERIALS, Scene, SceneObject
from data.render.appearance import RGB, mesh, texture
from data.render.floor import Floor
from data.world.camera import STANDARD_VIEW, Camera, View
from data.world.physics import connect

VERSION = "bullet-1"

OVERSAMPLING = 2
NEAR, FAR = 0.1, 50.0
"""Distances of the clipping planes, simulator units."""


class BulletRenderer:
    """Renders frames of any scene at one size, in this process, without a window."""

    version = VERSION

    def __init__(self, width: int, height: int, view: View = STANDARD_VIEW) -> None:
        self._scene_view = view
        self._bullet = connect()
        self._fine = view.camera.sized(width * OVERSAMPLING, height * OVERSAMPLING)
        self._view_matrix = self._bullet.computeViewMatrix(self._fine.eye, [0, 0, 0], [0, 0, 1])
        self._projection = _projection(self._fine)
        self._floor = Floor(view.camera.sized(width, height), view.light)
        self._textures = self._load_textures()
        self._visuals: dict[SceneObject, int] = {}
        self._scene_id: str | None = None
        self._handles: list[int] = []

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """Render one frame as an RGB image."""
        self.pose(scene, frame)
        pixels, mask = self.capture()
        opaque = pixels.view(np.uint32)[..., 0] | np.uint32(0xFF000000)
        layers = np.where(mask >= 0, opaque, np.uint32(0))
        # RGBX, because Pillow would premultiply the colours of an RGBA image by alpha.
        fine = Image.frombuffer("RGBX", mask.shape[::-1], layers, "raw", "RGBX", 0, 1)
        *colors, cover = fine.reduce(OVERSAMPLING).split()
        shade = self._floor.shade(scene.positions[frame], self._shadow_boxes[frame])
        bands = []
        uncovered = 1 - np.asarray(cover, np.float32) / 255
        for color, tint in zip(colors, self._scene_view.floor, strict=True):
            band = shade * tint
            band *= uncovered
            band += color
            bands.append(Image.fromarray(np.rint(band, out=band).astype(np.uint8)))
        return Image.merge("RGB", bands)

    def pose(self, scene: Scene, frame: int) -> list[int]:
        """Move the objects to their poses at a frame, and return their handles in the mask."""
        if scene.scene_id != self._scene_id:
            self._load(scene)
        for handle, scene_object, place, turn in zip(
            self._handles,
            scene.objects,
            scene.positions[frame].tolist(),
            scene.quaternions[frame].tolist(),
            strict=True,
        ):
            # A rolling sphere is not turned, because its texture is a reflection of the sky.
            turn = [0, 0, 0, 1] if scene_object.shape == "sphere" else turn
            self._bullet.resetBasePositionAndOrientation(handle, place, turn)
        return list(self._handles)

    def capture(self) -> tuple[np.ndarray, np.ndarray]:
        """Render the objects without a floor at OVERSAMPLING times the size.

        Returns:
            Pixels (H, W, 4) uint8, and the mask (H, W) int32: an object's handle or -1.
        """
        _, _, pixels, _, mask = self._bullet.getCameraImage(
            self._fine.width,
            self._fine.height,
            self._view_matrix,
            self._projection,
            lightDirection=self._scene_view.light,
            lightColor=[1, 1, 1],
            shadow=0,
            lightAmbientCoeff=0.45,
            lightDiffuseCoeff=0.6,
            lightSpecularCoeff=0.6,
            renderer=self._bullet.ER_TINY_RENDERER,
        )
        return pixels, mask

    def _load_textures(self) -> dict[str, int]:
        with tempfile.TemporaryDirectory() as folder:
            # Bullet reads textures only from files.
            paths = {material: Path(folder) / f"{material}.png" for material in MATERIALS}
            for material, path in paths.items():
                Image.fromarray(texture(material)).save(path)
            return {m: self._bullet.loadTexture(str(path)) for m, path in paths.items()}

    def _load(self, scene: Scene) -> None:
        # resetSimulation would leak megabytes each time.
        for handle in self._handles:
            self._bullet.removeBody(handle)
        self._handles = [self._add(scene_object) for scene_object in scene.objects]
        self._shadow_boxes = self._floor.shadow_boxes(scene.positions)
        self._scene_id = scene.scene_id

    def _add(self, scene_object: SceneObject) -> int:
        bullet = self._bullet
        if scene_object not in self._visuals:
            vertices, normals, uvs, triangles = mesh(scene_object.shape)
            shine = 1.0 if scene_object.material == "metal" else 0.05
            self._visuals[scene_object] = bullet.createVisualShape(
                bullet.GEOM_MESH,
                vertices=vertices.tolist(),
                normals=normals.tolist(),
                uvs=uvs.tolist(),
                indices=triangles.ravel().tolist(),
                rgbaColor=[*(np.array(RGB[scene_object.color]) / 255), 1],
                specularColor=[shine] * 3,
            )
        handle = bullet.createMultiBody(0, -1, self._visuals[scene_object])
        bullet.changeVisualShape(handle, -1, textureUniqueId=self._textures[scene_object.material])
        return handle


def _projection(camera: Camera) -> list[float]:
    """Return OpenGL's projection matrix for square pixels, in column-major order."""
    x, y = 2 * camera.focal / camera.width, 2 * camera.focal / camera.height
    depth, shift = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    return [x, 0, 0, 0, 0, y, 0, 0, 0, 0, depth, -1, 0, 0, shift, 0]
