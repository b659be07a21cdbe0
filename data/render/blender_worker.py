"""The worker process of `data.render.blender`, which needs only `bpy` and the standard library.

Blender has one global scene, prints to standard output and may crash, so it runs in a separate
process. Each request is a line of JSON on standard input: first the settings (see `Studio`), then
the objects of each frame (see `Studio.render`). Each response is a line on standard output with the
path of a PNG, which the next request overwrites; the first response only shows that Blender has
started. The process exits when its input ends.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

MATERIALS = {
    "metal": {"Metallic": 1.0, "Roughness": 0.15, "IOR": 2.5},
    "rubber": {"Metallic": 0.0, "Roughness": 0.7, "IOR": 1.25, "Specular IOR Level": 0.33},
    "ground": {"Metallic": 0.0, "Roughness": 1.0, "Specular IOR Level": 0.0},
}
"""Inputs of Blender's Principled BSDF."""
GROUND = (0.36, 0.355, 0.34)
"""The ground's colour, linear RGB."""
BEVEL = 0.05
"""Radius of rounded edges as a fraction of half the height; sharp edges would not reflect light."""
LAMPS = {
    "key": {"location": (3.5, -3.5, 5.5), "size": 2.0, "watts": 500},
    "fill": {"location": (3.0, 4.5, 3.5), "size": 3.0, "watts": 170},
    "back": {"location": (-4.5, 1.5, 4.5), "size": 2.0, "watts": 220},
}
"""Square lamps that point at the origin, in simulator units; larger ones cast softer shadows."""
AMBIENT = 0.1
"""Strength of ambient light, so that shadows and reflections are not black."""
IMAGE = {"file_format": "PNG", "color_mode": "RGB", "compression": 0}
SAMPLING = {
    # Sampling of a pixel stops at this noise level, but not before this number of samples.
    "adaptive_threshold": 0.05,
    "adaptive_min_samples": 8,
    "use_denoising": True,
    "denoiser": "OPENIMAGEDENOISE",
    "max_bounces": 3,
    "use_light_tree": False,
}
"""Settings of Blender's path tracer."""


def main() -> None:
    # Only responses may reach standard output, to which Blender prints too.
    responses = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with tempfile.TemporaryDirectory(prefix="dynapix-blender-") as folder:
        path = Path(folder) / "frame.png"
        studio = Studio(json.loads(sys.stdin.readline()), path)
        print(path, file=responses, flush=True)
        for line in sys.stdin:
            studio.render(json.loads(line))
            print(path, file=responses, flush=True)


class Studio:
    """A Blender scene with ground, lamps, a camera and one body for each appearance."""

    def __init__(self, settings: dict[str, Any], path: Path) -> None:
        """Set up the scene, whose rendered frames are written to `path`.

        Args:
            settings: width and height (px), focal (px), the camera's eye and axes (right, down,
                forward), samples, and half_heights by shape.
        """
        import bpy

        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.render.filepath = str(path)
        self._half_heights = settings["half_heights"]
        self._solids: dict[tuple[str, str, tuple[float, ...]], Any] = {}
        _set_quality(settings)
        _add_camera(settings)
        _add_lamps()
        bpy.ops.mesh.primitive_plane_add(size=80)
        bpy.context.object.data.materials.append(_material("ground", GROUND))

    def render(self, objects: list[dict[str, Any]]) -> None:
        """Render objects to the file: dicts with shape, material, color (linear RGB), position and
        quaternion (x y z w)."""
        import bpy

        for solid in self._solids.values():
            solid.hide_render = True
        for item in objects:
            appearance = (item["shape"], item["material"], tuple(item["color"]))
            if appearance not in self._solids:
                self._solids[appearance] = self._add(*appearance)
            solid = self._solids[appearance]
            x, y, z, w = item["quaternion"]
            solid.location, solid.rotation_quaternion = item["position"], (w, x, y, z)
            solid.hide_render = False
        bpy.ops.render.render(write_still=True)

    def _add(self, shape: str, material: str, color: tuple[float, ...]) -> Any:
        import bpy

        half = self._half_heights[shape]
        if shape == "sphere":
            bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=half)
        elif shape == "cylinder":
            bpy.ops.mesh.primitive_cylinder_add(vertices=96, radius=half, depth=2 * half)
        else:
            bpy.ops.mesh.primitive_cube_add(size=2 * half)
        bpy.ops.object.shade_smooth()
        solid = bpy.context.object
        solid.rotation_mode = "QUATERNION"
        solid.data.materials.append(_material(material, color))
        if shape != "sphere":
            bevel = solid.modifiers.new("edges", "BEVEL")
            bevel.width, bevel.segments = BEVEL * half, 3
            # Without it, smooth shading would make the flat faces look curved.
            solid.modifiers.new("shading", "WEIGHTED_NORMAL")
        return solid


def _material(name: str, color: tuple[float, ...]) -> Any:
    import bpy

    material = bpy.data.materials.new(name)
    material.use_nodes = True
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value = (*color, 1)
    for key, value in MATERIALS[name].items():
        inputs[key].default_value = value
    return material


def _set_quality(settings: dict[str, Any]) -> None:
    import bpy

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = settings["width"], settings["height"]
    # Blender's default transform would desaturate the objects' colours.
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0
    scene.cycles.samples = settings["samples"]
    for group, values in ((scene.render.image_settings, IMAGE), (scene.cycles, SAMPLING)):
        for key, value in values.items():
            setattr(group, key, value)
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL"):
        try:
            preferences.compute_device_type = kind
        except TypeError:  # not supported by this build of Blender
            continue
        preferences.refresh_devices()
        gpus = [device for device in preferences.devices if device.type == kind]
        for gpu in gpus:
            gpu.use = True
        if gpus:
            scene.cycles.device = "GPU"
            return


def _add_camera(settings: dict[str, Any]) -> None:
    import bpy
    from mathutils import Matrix

    bpy.ops.object.camera_add()
    camera = bpy.context.scene.camera = bpy.context.object
    lens = camera.data
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = settings["focal"] * lens.sensor_width / settings["width"]
    right, down, forward = settings["axes"]
    # Blender's cameras look along their -z axis, with y up.
    turn = Matrix([right, [-v for v in down], [-v for v in forward]]).transposed()
    camera.matrix_world = Matrix.Translation(settings["eye"]) @ turn.to_4x4()


def _add_lamps() -> None:
    import bpy
    from mathutils import Vector

    for lamp in LAMPS.values():
        # Blender's lamps shine along their -z axis.
        turn = Vector(lamp["location"]).to_track_quat("Z", "Y").to_euler()
        bpy.ops.object.light_add(type="AREA", location=lamp["location"], rotation=turn)
        light = bpy.context.object.data
        light.size, light.energy = lamp["size"], lamp["watts"]
    world = bpy.context.scene.world = bpy.data.worlds.new("ambient")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"].inputs
    background["Color"].default_value, background["Strength"].default_value = (1, 1, 1, 1), AMBIENT


if __name__ == "__main__":
    main()
