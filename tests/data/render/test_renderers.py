"""Renderers: imports, shadows, memory, and the errors of a renderer that cannot run."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from dynapix.conf.compose import compose
from dynapix.conf.schema import BuildCommand
from dynapix.data import versions
from dynapix.data.build import ensure_benchmark
from dynapix.data.records import Scene
from dynapix.data.render import RENDERERS, blender, get_renderer
from dynapix.data.render.blender import BPY, SAMPLES
from dynapix.data.render.bullet import BulletRenderer
from dynapix.data.render.floor import Floor
from dynapix.data.sim.camera import Camera
from tests.children import run_child
from tests.data.simulated import CLEVRER, simulate_scene
from tests.user_errors import raises_user_error


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate_scene(7, 1)


def test_versions_need_no_renderer_package() -> None:
    code = (
        "import sys, dynapix.data.store\n"
        "assert not {'pybullet', 'bpy'} & set(sys.modules)\n"
        "assert not {'dynapix.data.render', 'dynapix.data.items'} & set(sys.modules)"
    )
    run_child([sys.executable, "-c", code], check=True)


def test_version_of_blender_names_its_release_and_samples() -> None:
    assert BPY in versions.RENDERERS["blender"]
    assert f"{SAMPLES} samples" in versions.RENDERERS["blender"]
    assert versions.RENDERERS.keys() == RENDERERS.keys()


def test_shadow_is_confined_to_its_box() -> None:
    """Tested for objects on screen, at its edges, far away and behind the camera."""
    floor = Floor(Camera().sized(192, 128), CLEVRER)
    width, height = 192, 128
    rng = np.random.default_rng(0)
    for spread in (1.0, 3.0, 8.0):
        positions = rng.uniform(-spread, spread, (6, 3)).astype(np.float32)
        everywhere = np.tile([0, 0, width, height], (6, 1))
        scales = rng.uniform(0.5, 2.0, 6)
        boxes = floor.shadow_boxes(positions, scales)
        shade = floor.shade(positions, scales, boxes)
        np.testing.assert_array_equal(shade, floor.shade(positions, scales, everywhere))
    middle = np.zeros((1, 3), np.float32)
    lit = floor.shade(middle[:0], [], boxes[:0])
    darker = floor.shade(middle, [1.0], floor.shadow_boxes(middle, [1.0])) < lit
    assert 0 < darker.mean() < 0.5


def test_scenes_with_one_id_have_their_own_shadows(scene: Scene) -> None:
    """Alternative futures of a scene are compared under one id before they are saved."""
    other = replace(simulate_scene(1, 0), scene_id=scene.scene_id)
    renderer = BulletRenderer(96, 64, CLEVRER)
    renderer.render(scene, 100)
    after = np.asarray(renderer.render(other, 100))
    alone = np.asarray(BulletRenderer(96, 64, CLEVRER).render(other, 100))
    np.testing.assert_array_equal(after, alone)


def test_rendering_many_scenes_does_not_leak_memory(scene: Scene) -> None:
    others = [scene, *(simulate_scene(7, k) for k in (2, 3))]
    renderer = BulletRenderer(48, 32, CLEVRER)
    used = []
    for _ in range(2):
        for k in range(30):
            renderer.render(others[k % 3], 0)
        used.append(psutil.Process().memory_info().rss)
    assert used[1] - used[0] < 10 << 20


def test_blender_without_its_module_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blender, "BPY", "0.0.0")
    with raises_user_error("missing-package", contains=("0.0.0", ".[blender]")):
        get_renderer({"renderer": "blender", "width": 48, "height": 32, "world": asdict(CLEVRER)})


def test_blender_is_checked_before_a_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blender, "BPY", "0.0.0")
    cfg = compose("data.build", BuildCommand, ["benchmark=small", "benchmark.renderer=blender"])
    with raises_user_error("missing-package", contains="0.0.0"):
        ensure_benchmark(cfg.benchmark, tmp_path, workers=1)
    assert not any(tmp_path.iterdir())


def test_crash_of_blender_names_the_frame(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fake worker follows the protocol, returns one frame and exits at the next request."""
    dying = tmp_path / "dying.py"
    png = tmp_path / "frame.png"
    Image.new("RGB", (48, 32), "red").save(png)
    dying.write_text(
        "import json, sys\n"
        "assert json.loads(input())['samples'] > 0\n"
        f"print({str(png)!r}, flush=True)\n"
        "assert len(json.loads(input())) > 1\n"
        f"print({str(png)!r}, flush=True)\n"
        "input()\n"
        "sys.exit('out of memory')\n"
    )
    monkeypatch.setattr(blender, "WORKER", dying)
    monkeypatch.setattr(blender, "version", lambda package: blender.BPY)
    renderer = blender.BlenderRenderer(48, 32, CLEVRER)
    assert renderer.render(scene, 4).getpixel((0, 0)) == (255, 0, 0)
    with raises_user_error("renderer-failed", contains=(f"frame 5 of {scene.scene_id}", "memory")):
        renderer.render(scene, 5)
