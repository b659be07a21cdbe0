"""Renderer with Bullet's software rasteriser.

Bullet's TinyRenderer draws the objects as smooth meshes without OpenGL. Metal has a texture that
imitates a reflection, and a sharp highlight; rubber is matt. TinyRenderer can neither clip a large
floor nor soften a shadow, so this module draws the floor and soft shadows wherever no object is.
Objects are rendered at twice the size and averaged, for anti-aliasing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from dynapix.conf.schema import WorldConfig
from dynapix.data.records import MATERIALS, Scene, SceneObject
from dynapix.data.render.appearance import RGB, Mesh, box_mesh, mesh, texture
from dynapix.data.render.floor import Floor
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.physics import start_bullet

OVERSAMPLING = 2
NEAR, FAR = 0.1, 50.0
"""Distances of the clipping planes, simulator units."""
PART = 2**20
"""Value of the mask at parts, which is no handle of an object."""


class BulletRenderer:
    """Renders frames of any scene at one size, in this process, without a window."""

    def __init__(self, width: int, height: int, world: WorldConfig) -> None:
        self._world = world
        self._bullet = start_bullet()
        camera = Camera.from_settings(world.camera)
        self._fine = camera.sized(width * OVERSAMPLING, height * OVERSAMPLING)
        self._view_matrix = self._bullet.computeViewMatrix(camera.eye, camera.aim, [0, 0, 1])
        self._projection = _projection(self._fine)
        self._floor = Floor(camera.sized(width, height), world)
        self._textures = self._load_textures()
        self._visuals: dict[tuple[SceneObject, float], int] = {}
        self._parts = self._draw_parts() if world.parts else None
        self._scene: Scene | None = None
        self._handles: list[int] = []

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """Render one frame as an RGB image."""
        self.pose(scene, frame)
        pixels, mask = self.capture()
        layers = np.where(mask >= 0, pixels | np.uint32(0xFF000000), np.uint32(0))
        # RGBX, because Pillow would premultiply the colours of an RGBA image by alpha.
        fine = Image.frombuffer("RGBX", mask.shape[::-1], layers, "raw", "RGBX", 0, 1)
        *colors, cover = fine.reduce(OVERSAMPLING).split()
        boxes = self._shadow_boxes[frame]
        shade = self._floor.shade(scene.positions[frame], scene.object_scales, boxes)
        bands = []
        uncovered = 1 - np.asarray(cover, np.float32) / 255
        world = self._world
        for color, tint, sky in zip(colors, world.floor, world.background, strict=True):
            band = self._floor.paint(shade, tint, sky)
            band *= uncovered
            band += color
            bands.append(Image.fromarray(np.rint(band, out=band).astype(np.uint8)))
        return Image.merge("RGB", bands)

    def pose(self, scene: Scene, frame: int) -> list[int]:
        """Move the objects to their poses at a frame, and return their handles in the mask."""
        if scene is not self._scene:
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
        """Render the objects and parts without a floor at OVERSAMPLING times the size.

        Returns:
            Pixels (H, W) uint32, each four bytes RGBA, and the mask (H, W) int32: the handle of an
            object, PART or -1.
        """
        pixels, depth, mask = self._draw()
        if self._parts is not None:
            part_pixels, part_depth, _ = self._parts
            hidden = part_depth < depth
            np.copyto(pixels, part_pixels, where=hidden)
            np.copyto(mask, PART, where=hidden)
        return pixels, mask

    def _draw(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw the bodies of Bullet's world.

        Returns:
            Pixels (H, W) uint32; depths (H, W), 1 where nothing is drawn; and the handle of the
            body at each pixel (H, W), -1 where there is none.
        """
        _, _, pixels, depth, mask = self._bullet.getCameraImage(
            self._fine.width,
            self._fine.height,
            self._view_matrix,
            self._projection,
            lightDirection=self._world.light.direction,
            lightColor=[1, 1, 1],
            shadow=0,
            lightAmbientCoeff=self._world.light.ambient,
            lightDiffuseCoeff=self._world.light.diffuse,
            lightSpecularCoeff=0.6,
            renderer=self._bullet.ER_TINY_RENDERER,
        )
        return pixels.view(np.uint32)[..., 0], depth, mask

    def _draw_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw the world's parts. They never move, so that one drawing serves all frames."""
        handles = []
        for box, part in zip(world_boxes(self._world), self._world.parts.values(), strict=True):
            visual = self._add_visual(box_mesh(np.array(box.half)), part.color, shine=0.05)
            handles.append(self._add_body(visual, "rubber", box.position, box.quaternion))
        layer = self._draw()
        for handle in handles:
            self._bullet.removeBody(handle)
        return layer

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
        self._handles = [
            self._add(*each) for each in zip(scene.objects, scene.object_scales, strict=True)
        ]
        self._shadow_boxes = self._floor.shadow_boxes(scene.positions, scene.object_scales)
        self._scene = scene

    def _add(self, scene_object: SceneObject, scale: float) -> int:
        look = scene_object, scale
        if look not in self._visuals:
            vertices, *rest = mesh(scene_object.shape)
            shine = 1.0 if scene_object.material == "metal" else 0.05
            color = RGB[scene_object.color]
            self._visuals[look] = self._add_visual((vertices * scale, *rest), color, shine)
        return self._add_body(self._visuals[look], scene_object.material)

    def _add_body(self, visual: int, material: str, *pose: Sequence[float]) -> int:
        handle = self._bullet.createMultiBody(0, -1, visual, *pose)
        self._bullet.changeVisualShape(handle, -1, textureUniqueId=self._textures[material])
        return handle

    def _add_visual(self, surface: Mesh, color: Sequence[float], shine: float) -> int:
        vertices, normals, uvs, triangles = surface
        return self._bullet.createVisualShape(
            self._bullet.GEOM_MESH,
            vertices=vertices.tolist(),
            normals=normals.tolist(),
            uvs=uvs.tolist(),
            indices=triangles.ravel().tolist(),
            rgbaColor=[*(np.array(color) / 255), 1],
            specularColor=[shine] * 3,
        )


def _projection(camera: Camera) -> list[float]:
    """Return OpenGL's projection matrix for square pixels, in column-major order."""
    x, y = 2 * camera.focal / camera.width, 2 * camera.focal / camera.height
    depth, shift = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    return [x, 0, 0, 0, 0, y, 0, 0, 0, 0, depth, -1, 0, 0, shift, 0]
