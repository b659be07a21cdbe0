"""Renderer with Cycles, Blender's path tracer: reflections on metal and soft shadows.

Blender runs in a separate process (`blender_worker.py`), which exits when this process ends.
Blender uses a GPU if there is one; GPU pixels differ slightly from CPU pixels.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from PIL import Image

from dynapix.conf.errors import UserError
from dynapix.conf.schema import WorldConfig
from dynapix.data.records import Scene
from dynapix.data.render.appearance import RGB
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.shapes import CUBE_HALF, RADIUS

BPY = "4.2.23"
"""Release of Blender's Python module; other releases give other pixels."""
SAMPLES = 32
"""Maximum number of light paths per pixel; a denoiser removes the remaining noise."""

WORKER = Path(__file__).with_name("blender_worker.py")


def check_blender() -> None:
    """Raises UserError if the module `bpy` is missing or of another release."""
    try:
        installed = version("bpy")
    except PackageNotFoundError:
        installed = None
    if installed != BPY:
        raise UserError(
            f"benchmark.renderer=blender needs Blender's module bpy {BPY} (installed: "
            f"{installed}): install it with pip install -e '.[blender]', or use "
            "benchmark.renderer=bullet",
            code="missing-package",
        )


class BlenderRenderer:
    """Renders frames of any scene at one size, in one Blender process.

    Only the camera of the world is used. `blender_worker.py` defines the lamps and the ground.
    """

    def __init__(self, width: int, height: int, world: WorldConfig) -> None:
        """Start Blender. Raises UserError as `check_blender` does."""
        check_blender()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as the worker
        # Without -P, imports in the worker would find the modules of this folder first.
        self._worker = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        camera = Camera.from_settings(world.camera).sized(width, height)
        settings = {
            "width": width,
            "height": height,
            "focal": camera.focal,
            "eye": camera.eye,
            "axes": camera.axes.tolist(),
            "half_heights": {"cube": CUBE_HALF, "sphere": RADIUS, "cylinder": RADIUS},
            "samples": SAMPLES,
        }
        self._request(settings, "starting")

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """Render one frame as an RGB image. Raises UserError if the Blender process ended."""
        positions, quaternions = scene.positions[frame], scene.quaternions[frame]
        poses = zip(scene.objects, positions.tolist(), quaternions.tolist(), strict=True)
        objects = [
            {
                "shape": each.shape,
                "material": each.material,
                "color": [_linear(value / 255) for value in RGB[each.color]],
                "position": position,
                "quaternion": quaternion,
            }
            for each, position, quaternion in poses
        ]
        path = self._request(objects, f"rendering frame {frame} of {scene.scene_id}")
        return Image.open(path).convert("RGB")

    def _request(self, request: Any, activity: str) -> str:
        """Send a request to the worker and return its response."""
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps(request), file=self._worker.stdin, flush=True)
            if response := self._worker.stdout.readline():
                return response.rstrip("\n")
        status = self._worker.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        last = [f"status {status}", *filter(str.strip, lines)][-1].strip()
        raise UserError(
            f"Blender ended while {activity} ({last}); run the command again, with fewer workers "
            "if memory is short, or use benchmark.renderer=bullet",
            code="renderer-failed",
        )


def _linear(value: float) -> float:
    """Convert an sRGB value in [0, 1] to linear light."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
