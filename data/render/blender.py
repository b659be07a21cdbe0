"""Frames of a scene by Cycles, Blender's path tracer: metal that mirrors, and soft shadows.

Blender runs in a process of its own (`blender_worker.py`), which ends with this one. It draws on a
graphics card where it finds one; a card's pixels differ a little from a processor's.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from conf.errors import UserError
from data.records import Scene
from data.render.appearance import RGB, STANDARD_VIEW, View
from data.world.shapes import CUBE_HALF, RADIUS

BPY = "4.2.23"
"""The release of Blender's module that the extra `blender` installs; another draws other pixels."""
SAMPLES = 32
"""Light paths a pixel at most; what noise is left goes with the denoiser."""
VERSION = f"blender-1, bpy {BPY}, {SAMPLES} samples"

WORKER = Path(__file__).with_name("blender_worker.py")


class BlenderRenderer:
    """Draws frames of any scene at one size, in a Blender of its own, whose lamps and ground are
    those of `blender_worker.py` under any view."""

    version = VERSION

    def __init__(self, width: int, height: int, view: View = STANDARD_VIEW) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  as long as the worker
        # Without -P the worker would take the files beside it for libraries.
        self._worker = subprocess.Popen(
            [sys.executable, "-P", str(WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )
        camera = view.camera.sized(width, height)
        picture = {
            "width": width,
            "height": height,
            "focal": camera.focal,
            "eye": camera.eye,
            "axes": camera.axes.tolist(),
            "half_heights": {"cube": CUBE_HALF, "sphere": RADIUS, "cylinder": RADIUS},
            "samples": SAMPLES,
        }
        self._ask(picture, "starting")

    @staticmethod
    def check() -> None:
        """Raises UserError where Blender's module is not installed, or another release of it."""
        needs = f"renderer=blender needs Blender's module bpy {BPY}"
        mend = "install it with pip install -e '.[blender]', or use renderer=bullet"
        try:
            found = importlib.metadata.version("bpy")
        except importlib.metadata.PackageNotFoundError as error:
            raise UserError(f"{needs}, which is not installed: {mend}") from error
        if found != BPY:
            raise UserError(f"{needs}, and {found} is installed: {mend}")

    def render(self, scene: Scene, frame: int) -> Image.Image:
        """One frame as an RGB image of this renderer's size.

        Raises:
            UserError: Blender came to an end.
        """
        objects = [
            {
                "shape": look.shape,
                "material": look.material,
                "color": [_linear(value / 255) for value in RGB[look.color]],
                "position": place,
                "quaternion": turn,
            }
            for look, place, turn in zip(
                scene.objects,
                scene.positions[frame].tolist(),
                scene.quaternions[frame].tolist(),
                strict=True,
            )
        ]
        png = self._ask(objects, f"drawing frame {frame} of {scene.scene_id}")
        return Image.open(io.BytesIO(png)).convert("RGB")

    def _ask(self, request: Any, doing: str) -> bytes:
        """The bytes that answer a request."""
        try:
            self._worker.stdin.write(json.dumps(request).encode() + b"\n")
            self._worker.stdin.flush()
            header = self._worker.stdout.readline()
            if header:
                return self._worker.stdout.read(json.loads(header)["bytes"])
        except BrokenPipeError:
            pass
        status = self._worker.wait()
        self._errors.seek(0)
        words = self._errors.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(words) if line.strip()), f"status {status}")
        raise UserError(
            f"renderer=blender: Blender ended while {doing} ({last}); run the same command again, "
            "with fewer workers where memory is short, or use renderer=bullet"
        )


def _linear(value: float) -> float:
    """An sRGB value in [0, 1] as the share of light that it stands for."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
