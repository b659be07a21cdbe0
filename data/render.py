"""Frames of a scene by Bullet's rasteriser.

Bullet's software renderer (TinyRenderer, no OpenGL) draws the objects from smooth meshes, metal
with a reflection-like texture and a sharp highlight, rubber matt. It cannot clip a large floor nor
soften a shadow, so floor and contact shadows are shaded here, behind the objects' mask. Frames are
drawn at twice the size and averaged, which smooths the outlines.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from data.bullet import connect
from data.geometry import CUBE_HALF, RADIUS, Camera
from data.records import COLORS, Scene

RENDERER_VERSION = "bullet-1"
"""Part of a benchmark's identity: changes whenever the same oracle would give other pixels."""

RGB = dict(
    zip(
        COLORS,
        [
            (112, 112, 112),
            (186, 38, 38),
            (38, 72, 204),
            (34, 136, 34),
            (122, 66, 22),
            (38, 196, 196),
            (132, 38, 186),
            (250, 230, 48),
        ],
        strict=True,
    )
)
"""Colours as CLEVRER names them; green and brown a little darker so that small objects differ."""

SEGMENTS = 48
OVERSAMPLING = 2
NEAR, FAR = 0.1, 50.0
FLOOR = (158.0, 156.0, 152.0)
SHADOW_DEPTH = 0.55
LIGHT = (3.0, 3.0, 6.0)


class BulletRenderer:
    """Draws frames of any scene at one size, in this process, without a window."""

    def __init__(self, width: int, height: int) -> None:
        self._bullet = connect()
        self._fine = _camera(width * OVERSAMPLING, height * OVERSAMPLING)
        self._view = self._bullet.computeViewMatrix(self._fine.eye, [0, 0, 0], [0, 0, 1])
        self._projection = _projection(self._fine)
        self._floor = _floor_points(_camera(width, height))
        self._scene_id: str | None = None
        self._handles: list[int] = []

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """One frame as an RGB image of this renderer's size."""
        if scene.scene_id != self._scene_id:
            self._load(scene)
        for handle, look, place, turn in zip(
            self._handles,
            scene.objects,
            scene.positions[frame].tolist(),
            scene.quaternions[frame].tolist(),
            strict=True,
        ):
            # A reflection stays where the room is while a ball rolls.
            turn = [0, 0, 0, 1] if look.shape == "sphere" else turn
            self._bullet.resetBasePositionAndOrientation(handle, place, turn)
        objects, cover = self._draw()
        floor = self._shade_floor(scene.positions[frame])
        image = objects + (1 - cover[..., None]) * floor
        return Image.fromarray(image.round().astype(np.uint8))

    def _load(self, scene: Scene) -> None:
        bullet = self._bullet
        bullet.resetSimulation()
        with tempfile.TemporaryDirectory() as folder:
            textures = {
                material: bullet.loadTexture(_save_texture(material, Path(folder)))
                for material in ("metal", "rubber")
            }
        self._handles = []
        for look in scene.objects:
            vertices, normals, uvs, indices = mesh(look.shape)
            shine = 1.0 if look.material == "metal" else 0.05
            visual = bullet.createVisualShape(
                bullet.GEOM_MESH,
                vertices=vertices.tolist(),
                normals=normals.tolist(),
                uvs=uvs.tolist(),
                indices=indices.ravel().tolist(),
                rgbaColor=[*(np.array(RGB[look.color]) / 255), 1],
                specularColor=[shine] * 3,
            )
            handle = bullet.createMultiBody(0, -1, visual)
            bullet.changeVisualShape(handle, -1, textureUniqueId=textures[look.material])
            self._handles.append(handle)
        self._scene_id = scene.scene_id

    def _draw(self) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) objects on black and (H, W) the share of each pixel that they cover."""
        width, height = self._fine.width, self._fine.height
        _, _, pixels, _, mask = self._bullet.getCameraImage(
            width,
            height,
            self._view,
            self._projection,
            lightDirection=LIGHT,
            lightColor=[1, 1, 1],
            shadow=0,
            lightAmbientCoeff=0.45,
            lightDiffuseCoeff=0.6,
            lightSpecularCoeff=0.6,
            renderer=self._bullet.ER_TINY_RENDERER,
        )
        drawn = np.array(pixels, dtype=np.uint8).reshape(height, width, 4)
        drawn[..., 3] = np.where(np.reshape(mask, (height, width)) >= 0, 255, 0)
        drawn[drawn[..., 3] == 0] = 0
        # Averaged as four plain bands: averaging as RGBA would weigh colours by alpha once more.
        small = np.asarray(Image.fromarray(drawn, "CMYK").reduce(OVERSAMPLING), np.float32)
        return small[..., :3], small[..., 3] / 255

    def _shade_floor(self, positions: np.ndarray) -> np.ndarray:
        """(H, W, 3) floor under a soft light, darkened around where each object stands."""
        points, falloff = self._floor
        shade = falloff.copy()
        away = -np.asarray(LIGHT[:2]) / LIGHT[2]
        for x, y, _ in positions:
            centre = np.array([x, y]) + 0.5 * RADIUS * away
            distance = (points[..., 0] - centre[0]) ** 2 + (points[..., 1] - centre[1]) ** 2
            shade *= 1 - SHADOW_DEPTH * np.exp(-distance / (2 * (0.85 * RADIUS) ** 2))
        return shade[..., None] * np.asarray(FLOOR, dtype=np.float32)


@cache
def renderer(width: int, height: int) -> BulletRenderer:
    """This process's renderer for a frame size."""
    return BulletRenderer(width, height)


def _camera(width: int, height: int) -> Camera:
    """The standard camera at another resolution."""
    standard = Camera()
    return Camera(width, height, standard.focal * width / standard.width)


def _projection(camera: Camera) -> list[float]:
    """OpenGL's projection matrix, column by column, for square pixels."""
    x, y = 2 * camera.focal / camera.width, 2 * camera.focal / camera.height
    depth, shift = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    return [x, 0, 0, 0, 0, y, 0, 0, 0, 0, depth, -1, 0, 0, shift, 0]


def _floor_points(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 2) where each pixel's ray meets the ground, and (H, W) how bright the floor is there:
    brightest in the middle, falling off with distance as under one lamp."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(columns.astype(float), rows.astype(float))
    reach = camera.eye[2] / -rays[..., 2]
    points = np.asarray(camera.eye)[:2] + reach[..., None] * rays[..., :2]
    distance = np.linalg.norm(points - np.array([0.3, 0.0]), axis=-1)
    return points.astype(np.float32), (1.12 / (1 + (distance / 7.5) ** 2)).astype(np.float32)


def mesh(shape: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), normals (V, 3), texture coordinates (V, 2) and triangles (T, 3)."""
    if shape == "sphere":
        return _turned(*_sphere_profile())
    if shape == "cylinder":
        return _turned(*_cylinder_profile())
    return _cube()


def _sphere_profile() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    angle = np.linspace(0, np.pi, SEGMENTS // 2 + 1)
    normals = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return RADIUS * normals, normals, angle / np.pi


def _cylinder_profile() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # The rim stands twice, once with the cap's normal and once with the side's: a hard edge.
    points = RADIUS * np.array([[0, 1], [1, 1], [1, 1], [1, -1], [1, -1], [0, -1]], dtype=float)
    normals = np.array([[0, 1], [0, 1], [1, 0], [1, 0], [0, -1], [0, -1]], dtype=float)
    return points, normals, np.array([0.05, 0.2, 0.25, 0.75, 0.8, 0.95])


def _turned(
    points: np.ndarray, normals: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A profile of (radius, height) turned about the z axis."""
    turns = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
    around = np.stack([np.cos(turns), np.sin(turns)], axis=1)

    def spin(profile: np.ndarray) -> np.ndarray:
        flat = profile[:, None, 0, None] * around[None]
        return np.concatenate(
            [flat, np.broadcast_to(profile[:, None, 1:], (*flat.shape[:2], 1))], -1
        )

    uvs = np.stack(np.broadcast_arrays(turns[None] / (2 * np.pi), down[:, None]), axis=-1)
    row, column = np.meshgrid(np.arange(len(points) - 1), np.arange(SEGMENTS), indexing="ij")
    a = (row * (SEGMENTS + 1) + column).ravel()
    b = a + SEGMENTS + 1
    triangles = np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)])
    return spin(points).reshape(-1, 3), spin(normals).reshape(-1, 3), uvs.reshape(-1, 2), triangles


def _cube() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
    vertices, normals, triangles = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(corners, axis, side, axis=1)
            first, second, third = face[0], face[1], face[2]
            outward = np.cross(second - first, third - second)[axis] * side > 0
            base = 4 * len(vertices)
            vertices.append(face if outward else face[::-1])
            normals.append(np.tile(np.insert(np.zeros(2), axis, side), (4, 1)))
            triangles += [[base, base + 1, base + 2], [base, base + 2, base + 3]]
    uvs = np.tile((corners + 1) / 2, (6, 1))
    return (
        CUBE_HALF * np.concatenate(vertices),
        np.concatenate(normals),
        uvs,
        np.array(triangles),
    )


def texture(material: str) -> np.ndarray:
    """(64, 64, 3) uint8 that multiplies an object's colour: a mirrored sky above a dark horizon
    for metal, plain for rubber."""
    if material == "rubber":
        return np.full((64, 64, 3), 215, dtype=np.uint8)
    across, down = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 64))
    sky = np.where(down < 0.5, 1.0 - 0.5 * down, 0.15 + 1.1 * (down - 0.5))
    room = sky * (1 + 0.25 * np.cos(4 * np.pi * across))
    return (255 * np.clip(room, 0.1, 1)).astype(np.uint8)[..., None].repeat(3, 2)


def _save_texture(material: str, folder: Path) -> str:
    path = folder / f"{material}.png"
    Image.fromarray(texture(material)).save(path)
    return str(path)
