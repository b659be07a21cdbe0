"""Renderer with Bullet's software rasteriser.

TinyRenderer (no OpenGL) renders the objects from smooth meshes: metal with a reflection-like
texture and a sharp highlight, rubber matt. It can neither clip a large floor nor soften a shadow,
so this module adds the floor and contact shadows behind the objects' mask. Frames are rendered at
twice the size and averaged, for anti-aliasing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from data.records import MATERIALS, Scene, SceneObject
from data.render.appearance import RGB, STANDARD_VIEW, View, mesh, texture
from data.render.floor import Floor
from data.world.camera import Camera
from data.world.physics import connect

VERSION = "bullet-1"

OVERSAMPLING = 2
NEAR, FAR = 0.1, 50.0


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

    @staticmethod
    def check() -> None:
        """It has no requirements beyond those of the simulation."""

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """Render one frame as an RGB image."""
        self.pose(scene, frame)
        touched, objects, cover = _average(*self.capture())
        shade = self._floor.shade(scene.positions[frame], self._shadows[frame])
        bands = []
        for channel, tint in zip(objects, self._scene_view.floor, strict=True):
            plane = shade * tint
            pixels = plane.reshape(-1)
            pixels[touched] = channel + (1 - cover) * pixels[touched]
            bands.append(Image.fromarray(np.rint(plane, out=plane).astype(np.uint8)))
        return Image.merge("RGB", bands)

    def pose(self, scene: Scene, frame: int) -> list[int]:
        """Move the objects to their poses at a frame, and return their handles in the mask."""
        if scene.scene_id != self._scene_id:
            self._load(scene)
        for handle, look, place, turn in zip(
            self._handles,
            scene.objects,
            scene.positions[frame].tolist(),
            scene.quaternions[frame].tolist(),
            strict=True,
        ):
            # The reflection on a sphere does not move as it rolls.
            turn = [0, 0, 0, 1] if look.shape == "sphere" else turn
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
        self._handles = [self._add(look) for look in scene.objects]
        self._shadows = self._floor.shadows(scene.positions)
        self._scene_id = scene.scene_id

    def _add(self, look: SceneObject) -> int:
        bullet = self._bullet
        if look not in self._visuals:
            vertices, normals, uvs, triangles = mesh(look.shape)
            shine = 1.0 if look.material == "metal" else 0.05
            self._visuals[look] = bullet.createVisualShape(
                bullet.GEOM_MESH,
                vertices=vertices.tolist(),
                normals=normals.tolist(),
                uvs=uvs.tolist(),
                indices=triangles.ravel().tolist(),
                rgbaColor=[*(np.array(RGB[look.color]) / 255), 1],
                specularColor=[shine] * 3,
            )
        handle = bullet.createMultiBody(0, -1, self._visuals[look])
        bullet.changeVisualShape(handle, -1, textureUniqueId=self._textures[look.material])
        return handle


def _average(pixels: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Downsample the objects by two, at the pixels that they touch.

    Args:
        pixels: (2H, 2W, 4) uint8.
        mask: (2H, 2W) int32, -1 without an object.

    Returns:
        (P,) flat indices of the touched pixels in the small image; their colours (3, P) float32 on
        black; and (P,) float32 the share of each pixel that objects cover.
    """
    # Compares two neighbours at once: all bits of the mask are set where it has no object.
    pairs = mask.view(np.int64)
    touched = np.flatnonzero((pairs[0::2] & pairs[1::2]) != -1)
    width = mask.shape[1]
    row, column = np.divmod(touched, width // 2)
    first = 2 * row * width + 2 * column
    four = first + np.array([[0], [1], [width], [width + 1]])
    is_object = mask.ravel()[four] >= 0
    masked = pixels.view(np.uint32).ravel()[four] * is_object
    total = masked.view(np.uint8).reshape(4, -1).sum(axis=0, dtype=np.uint16)
    objects = ((total + 2) // 4).reshape(-1, 4)[:, :3].T.astype(np.float32)
    # Rounded to 1/255, as a fourth channel of the image would be.
    cover = (is_object.sum(axis=0, dtype=np.uint16) * 255 + 2) // 4
    return touched, objects, cover.astype(np.float32) / 255


def _projection(camera: Camera) -> list[float]:
    """OpenGL's projection matrix for square pixels, in column-major order."""
    x, y = 2 * camera.focal / camera.width, 2 * camera.focal / camera.height
    depth, shift = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    return [x, 0, 0, 0, 0, y, 0, 0, 0, 0, depth, -1, 0, 0, shift, 0]
