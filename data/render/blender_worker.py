"""Blender's side of `data.render.blender`: a program of its own that draws what it is asked to.

Blender keeps one global scene, prints to standard output, and may take its process down with it:
here it can. Each request is a line of JSON on standard input, first the picture (see `Studio`),
then one frame's objects after another (see `Studio.draw`). Each answer, on standard output, is a
line {"bytes": n} and n bytes: none for the picture, a PNG for a frame. The program ends when its
input does, for then nobody is left to draw for. It needs `bpy` and the standard library alone.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import threading
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO

MATERIALS = {
    "metal": {"Metallic": 1.0, "Roughness": 0.15, "IOR": 2.5},
    "rubber": {"Metallic": 0.0, "Roughness": 0.7, "IOR": 1.25, "Specular IOR Level": 0.33},
    "ground": {"Metallic": 0.0, "Roughness": 1.0, "Specular IOR Level": 0.0},
}
"""Inputs of Blender's Principled BSDF."""
GROUND = (0.36, 0.355, 0.34)
"""The ground's colour, linear RGB."""
BEVEL = 0.05
"""How far edges are rounded, as a share of half the height: a sharp edge catches no light."""
LAMPS = {
    "key": {"place": (3.5, -3.5, 5.5), "size": 2.0, "watts": 500},
    "fill": {"place": (3.0, 4.5, 3.5), "size": 3.0, "watts": 170},
    "back": {"place": (-4.5, 1.5, 4.5), "size": 2.0, "watts": 220},
}
"""Square lamps that look at the origin; the wider, the softer the shadows. Simulator units."""
AMBIENT = 0.1
"""Light from all around, which leaves no shadow and no reflection quite black."""
ADAPTIVE_NOISE, ADAPTIVE_MIN_SAMPLES = 0.05, 8
"""A pixel is done when its noise is under this, after these many samples; the denoiser does the
rest."""
BOUNCES = 3


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="dynapix-blender-") as folder:
        requests, answers = _channels(folder)
        studio = Studio(json.loads(requests.get()), Path(folder) / "frame.png")
        _answer(answers, b"")
        while True:
            _answer(answers, studio.draw(json.loads(requests.get())))


def _channels(folder: str) -> tuple[SimpleQueue[str], BinaryIO]:
    """Requests as they come, and the file for answers, out of reach of what Blender prints."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    requests: SimpleQueue[str] = SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            requests.put(line)
        # At once, not after the frame that is being drawn.
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    return requests, answers


def _answer(answers: BinaryIO, body: bytes) -> None:
    answers.write(json.dumps({"bytes": len(body)}).encode() + b"\n" + body)
    answers.flush()


class Studio:
    """Ground, lamps and camera, and a solid for each look, shown in the frames that have it."""

    def __init__(self, picture: dict[str, Any], path: Path) -> None:
        """A picture has width and height, focal (px), the camera's eye and axes (right, down,
        forward), samples, and half_heights by shape."""
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = bpy.context.scene
        self._scene.render.filepath = str(path)
        self._path = path
        self._meshes = {shape: _mesh(shape, h) for shape, h in picture["half_heights"].items()}
        self._solids: dict[tuple[str, str, tuple[float, ...]], Any] = {}
        _set_quality(self._scene, picture)
        _set_camera(self._scene, picture)
        _set_lamps(self._scene)
        _set_ground(self._scene)

    def draw(self, objects: list[dict[str, Any]]) -> bytes:
        """A PNG of objects, each with its shape, material, color (linear RGB), position and
        quaternion (x y z w)."""
        import bpy

        for solid in self._solids.values():
            solid.hide_render = True
        for shown in objects:
            look = (shown["shape"], shown["material"], tuple(shown["color"]))
            if look not in self._solids:
                self._solids[look] = self._add(*look)
            solid = self._solids[look]
            x, y, z, w = shown["quaternion"]
            solid.location, solid.rotation_quaternion = shown["position"], (w, x, y, z)
            solid.hide_render = False
        bpy.ops.render.render(write_still=True)
        return self._path.read_bytes()

    def _add(self, shape: str, material: str, color: tuple[float, ...]) -> Any:
        import bpy

        solid = bpy.data.objects.new(f"{material} {shape}", self._meshes[shape])
        solid.rotation_mode = "QUATERNION"
        solid.material_slots[0].link = "OBJECT"
        solid.material_slots[0].material = _material(material, color)
        if shape != "sphere":
            bevel = solid.modifiers.new("edges", "BEVEL")
            bevel.width, bevel.segments = BEVEL * solid.dimensions.z / 2, 3
            # Flat faces stay flat between their round edges.
            solid.modifiers.new("shading", "WEIGHTED_NORMAL")
        self._scene.collection.objects.link(solid)
        return solid


def _mesh(shape: str, half: float) -> Any:
    """A mesh of half height `half` with an empty slot for a material."""
    import bmesh
    import bpy

    form = bmesh.new()
    if shape == "sphere":
        bmesh.ops.create_uvsphere(form, u_segments=96, v_segments=48, radius=half)
    elif shape == "cylinder":
        bmesh.ops.create_cone(
            form, cap_ends=True, segments=96, radius1=half, radius2=half, depth=2 * half
        )
    else:
        bmesh.ops.create_cube(form, size=2 * half)
    for face in form.faces:
        face.smooth = True
    mesh = bpy.data.meshes.new(shape)
    form.to_mesh(mesh)
    form.free()
    mesh.materials.append(None)
    return mesh


def _material(name: str, color: tuple[float, ...]) -> Any:
    import bpy

    material = bpy.data.materials.new(name)
    material.use_nodes = True
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (*color, 1)
    for key, value in MATERIALS[name].items():
        inputs[key].default_value = value
    return material


def _set_quality(scene: Any, picture: dict[str, Any]) -> None:
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = picture["width"], picture["height"]
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.compression = 0
    scene.render.dither_intensity = 0
    # Blender's own choice, made for films, would grey the colours that objects are named by.
    scene.view_settings.view_transform = "Standard"
    scene.cycles.samples = picture["samples"]
    scene.cycles.adaptive_threshold = ADAPTIVE_NOISE
    scene.cycles.adaptive_min_samples = ADAPTIVE_MIN_SAMPLES
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.max_bounces = BOUNCES
    scene.cycles.use_light_tree = False
    _use_gpu(scene)


def _use_gpu(scene: Any) -> None:
    """Draw on the graphics cards, where Blender finds any."""
    import bpy

    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL"):
        try:
            preferences.compute_device_type = kind
        except TypeError:  # this build of Blender does not know the kind
            continue
        preferences.refresh_devices()
        cards = [device for device in preferences.devices if device.type == kind]
        for card in cards:
            card.use = True
        if cards:
            scene.cycles.device = "GPU"
            return


def _set_camera(scene: Any, picture: dict[str, Any]) -> None:
    import bpy
    from mathutils import Matrix

    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = picture["focal"] * lens.sensor_width / picture["width"]
    camera = bpy.data.objects.new("camera", lens)
    right, down, forward = picture["axes"]
    # A camera of Blender looks down its own -z, with y up.
    turn = Matrix([right, [-v for v in down], [-v for v in forward]]).transposed()
    camera.matrix_world = Matrix.Translation(picture["eye"]) @ turn.to_4x4()
    scene.collection.objects.link(camera)
    scene.camera = camera


def _set_lamps(scene: Any) -> None:
    import bpy
    from mathutils import Vector

    for name, lamp in LAMPS.items():
        light = bpy.data.lights.new(name, "AREA")
        light.size, light.energy = lamp["size"], lamp["watts"]
        solid = bpy.data.objects.new(name, light)
        solid.location = lamp["place"]
        # A lamp shines down its own -z.
        solid.rotation_euler = Vector(lamp["place"]).to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(solid)
    world = bpy.data.worlds.new("room")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"].inputs
    background["Color"].default_value, background["Strength"].default_value = (1, 1, 1, 1), AMBIENT
    scene.world = world


def _set_ground(scene: Any) -> None:
    import bpy

    mesh = bpy.data.meshes.new("ground")
    far = 40.0
    corners = [(-far, -far, 0), (far, -far, 0), (far, far, 0), (-far, far, 0)]
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    mesh.materials.append(_material("ground", GROUND))
    scene.collection.objects.link(bpy.data.objects.new("ground", mesh))


if __name__ == "__main__":
    main()
