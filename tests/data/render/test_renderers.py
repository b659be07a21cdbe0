"""Laws of the renderers: one interface, pixels by the oracle alone, and sentences where one cannot
run."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image

from conf.errors import UserError
from conf.schema import BenchmarkConfig
from data.records import Scene
from data.render import RENDERERS, blender, check_renderer, get_renderer
from data.render.appearance import STANDARD_VIEW
from data.render.bullet import BulletRenderer, _average
from data.render.egl import EglRenderer
from data.render.floor import Floor
from data.world.camera import Camera
from data.world.sampling import simulate_scene
from data.world.shapes import intersect_rays

LIMITS = BenchmarkConfig(name="renderers")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate_scene(7, 1, "train", LIMITS)


def test_versions_are_known_without_loading_what_draws() -> None:
    code = (
        "import sys\n"
        "from data.render import RENDERERS, version\n"
        "print(*(version(name) for name in RENDERERS), sep='\\n')\n"
        "assert not {'pybullet', 'bpy'} & set(sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    bullet, egl, blender_version = shown.stdout.splitlines()
    assert bullet == "bullet-1"
    assert len({bullet, egl, blender_version}) == len(RENDERERS)
    assert blender.BPY in blender_version
    assert str(blender.SAMPLES) in blender_version


def test_an_unknown_renderer_is_told_the_known_ones() -> None:
    with pytest.raises(UserError, match=r"blendr.*bullet, egl, blender"):
        get_renderer("blendr", 192, 128)


def test_objects_are_averaged_over_four_pixels_and_rounded_up_at_half() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (6, 10, 4), np.uint8)
    mask = rng.integers(-1, 2, (6, 10), np.int32)
    mask[:2, :4] = -1
    touched, objects, cover = _average(pixels, mask)
    seen = (mask >= 0)[..., None]
    four = np.dstack([pixels[..., :3] * seen, 255 * seen]).reshape(3, 2, 5, 2, 4)
    mean = np.floor(four.mean(axis=(1, 3)) + 0.5).reshape(15, 4)
    np.testing.assert_array_equal(touched, np.flatnonzero(mean[:, 3]))
    np.testing.assert_array_equal(objects, mean[touched, :3].T)
    np.testing.assert_array_equal(cover, mean[touched, 3].astype(np.float32) / 255)
    assert set(range(2)).isdisjoint(touched.tolist())


def test_a_shadow_reaches_no_pixel_beyond_its_box() -> None:
    """Objects on screen, at its edges, far off and behind the camera."""
    floor = Floor(STANDARD_VIEW.camera.sized(192, 128), STANDARD_VIEW.light)
    width, height = 192, 128
    rng = np.random.default_rng(0)
    for spread in (1.0, 3.0, 8.0):
        positions = rng.uniform(-spread, spread, (6, 3)).astype(np.float32)
        everywhere = np.tile([0, 0, width, height], (6, 1))
        boxes = floor.shadows(positions)
        shade = floor.shade(positions, boxes)
        np.testing.assert_array_equal(shade, floor.shade(positions, everywhere))
    middle = np.zeros((1, 3), np.float32)
    darker = floor.shade(middle, floor.shadows(middle)) < floor.shade(middle[:0], boxes[:0])
    assert 0 < darker.mean() < 0.5


def test_scene_after_scene_takes_no_more_memory(scene: Scene) -> None:
    others = [scene, *(simulate_scene(7, k, "train", LIMITS) for k in (2, 3))]
    drawn = BulletRenderer(48, 32)
    used = []
    for _ in range(2):
        for k in range(30):
            drawn.render(others[k % 3], 0)
        used.append(psutil.Process().memory_info().rss)
    assert used[1] - used[0] < 10 << 20


def test_egl_draws_what_rays_hit_or_says_what_is_missing(scene: Scene) -> None:
    missing = sentence_of_egl()
    if missing is not None:
        assert "renderer=bullet" in missing
        return
    for frame in (0, 60):
        mask, _ = objects_of(EglRenderer(240, 160), scene, frame)
        hit = nearest_objects(scene, frame, Camera())
        for k in range(len(scene.objects)):
            if (hit == k).sum() > 100:
                overlap = ((hit == k) & (mask == k)).sum() / ((hit == k) | (mask == k)).sum()
                assert overlap > 0.98, (frame, k)


def test_egl_gives_every_object_its_color_and_texture_or_says_what_is_missing(scene: Scene) -> None:
    """The scene has a metal cube among rubber ones; another scene stands on stage before it."""
    missing = sentence_of_egl()
    if missing is not None:
        assert "renderer=bullet" in missing
        return
    drawn, known = EglRenderer(240, 160), BulletRenderer(240, 160)
    drawn.render(simulate_scene(7, 2, "train", LIMITS), 60)
    found, expected = (objects_of(r, scene, 60) for r in (drawn, known))
    for k, look in enumerate(scene.objects):
        colors = [picture[mask == k].mean(axis=0) for mask, picture in (found, expected)]
        assert np.abs(colors[0] - colors[1]).max() < 30, look


def sentence_of_egl() -> str | None:
    """Why egl cannot run here, None where it can."""
    try:
        check_renderer("egl")
    except UserError as error:
        return str(error)
    return None


def objects_of(drawn: BulletRenderer, scene: Scene, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) the object at each pixel, -1 for none, and (H, W, 3) its colour there."""
    handles = drawn.pose(scene, frame)
    pixels, mask = drawn.photograph()
    index = np.full(mask.shape, -1)
    for k, handle in enumerate(handles):
        index[mask == handle] = k
    return index, pixels[..., :3].astype(float)


def nearest_objects(scene: Scene, frame: int, camera: Camera) -> np.ndarray:
    """(H, W) the object that each pixel's ray hits first, -1 for none."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(columns.ravel().astype(float), rows.ravel().astype(float))
    depths = np.stack(
        [
            intersect_rays(look.shape, place, turn, np.asarray(camera.eye), rays)
            for look, place, turn in zip(
                scene.objects, scene.positions[frame], scene.quaternions[frame], strict=True
            )
        ]
    )
    nearest = np.where(np.isfinite(depths).any(axis=0), depths.argmin(axis=0), -1)
    return nearest.reshape(camera.height, camera.width)


def test_without_a_driver_egl_ends_in_a_sentence() -> None:
    code = (
        "from conf.errors import UserError\n"
        "from data.render import renderer\n"
        "try: renderer('egl', 48, 32)\n"
        "except UserError as error: print(error)"
    )
    nowhere = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": os.devnull}
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=nowhere
    )
    (sentence,) = shown.stdout.splitlines()
    assert "driver" in sentence
    assert "renderer=bullet" in sentence


def test_blender_without_its_module_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blender, "BPY", "0.0.0")
    with pytest.raises(UserError, match=r"0\.0\.0.*pip install -e '\.\[blender\]'"):
        get_renderer("blender", 48, 32)


@pytest.fixture
def stub_bpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that Blender's side imports as bpy."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path / "bpy.py"


def test_a_blender_that_cannot_load_gives_its_last_words(stub_bpy: Path) -> None:
    stub_bpy.write_text("print('to no effect')\nraise ImportError('libSM.so.6 is not there')")
    with pytest.raises(UserError, match=r"while starting \(.*libSM.*renderer=bullet"):
        blender.BlenderRenderer(48, 32)


def test_blenders_side_ends_with_its_input_in_the_midst_of_work(stub_bpy: Path) -> None:
    stub_bpy.write_text("import time\nprint('busy', flush=True)\ntime.sleep(60)")
    worker = subprocess.Popen(
        [sys.executable, "-P", str(blender.WORKER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    worker.stdin.write(b'{"width": 48, "height": 32}\n')
    worker.stdin.close()
    assert worker.wait(timeout=10) == 0
    assert worker.stdout.read() == b""


def test_a_blender_that_dies_names_the_frame(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program in Blender's place that draws one frame, by the protocol, and is gone."""
    dying = tmp_path / "dying.py"
    png = io.BytesIO()
    Image.new("RGB", (48, 32), "red").save(png, "PNG")
    dying.write_text(
        "import json, sys\n"
        "from base64 import b64decode\n"
        "answer = lambda body: sys.stdout.buffer.write(b'{\"bytes\": %d}\\n' % len(body) + body)\n"
        "assert json.loads(input())['samples'] > 0\n"
        "answer(b''), sys.stdout.flush()\n"
        "assert len(json.loads(input())) > 1\n"
        f"answer({png.getvalue()!r}), sys.stdout.flush()\n"
        "input()\n"
        "sys.exit('out of memory')\n"
    )
    monkeypatch.setattr(blender, "WORKER", dying)
    drawn = blender.BlenderRenderer(48, 32)
    assert drawn.render(scene, 4).getpixel((0, 0)) == (255, 0, 0)
    with pytest.raises(UserError, match=rf"frame 5 of {scene.scene_id} \(out of memory\)"):
        drawn.render(scene, 5)
