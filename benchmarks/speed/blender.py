"""What renderer=blender draws, held against the oracle, and how long a frame takes. Needs the extra
`blender`.

    python -m benchmarks.speed.blender

Silhouettes are held against the rays of `data.world.geometry`. They are found by colour, for which
the
objects are given strong ones in rubber, that mirrors nothing. Ends with status 1 where a claim does
not hold.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import psutil

from conf.schema import BenchmarkConfig
from data.records import Scene, SceneObject
from data.render import check
from data.render.blender import BlenderRenderer
from data.world.geometry import Camera, hit_depth
from data.world.sampling import simulate_scene

SIZES = ((128, 128), (336, 224), (480, 320))
FRAMES = (20, 60, 100)
STRONG = ("red", "blue", "green", "purple", "cyan", "yellow")
OVERLAP = 0.95
"""Least intersection over union of a frame's silhouettes; a pixel's shift must make it less."""
UNEQUAL = 1e-4
"""Share of values that may differ, by one of 255, from one Blender to another: its denoiser's last
bits depend on where in memory a picture lies."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Check and time frames drawn by Blender.")
    parser.add_argument("--scenes", type=int, default=3)
    args = parser.parse_args()
    check("blender")
    limits = BenchmarkConfig(name="blender")
    scenes = [simulate_scene(0, k, "train", limits) for k in range(args.scenes)]
    failures = []
    drawn = BlenderRenderer(480, 320)
    for scene in scenes:
        for frame in FRAMES:
            overlap, shifted = agreement(drawn, strong(scene), frame)
            print(
                f"{scene.scene_id} frame {frame:>3}: overlap {overlap:.3f}, "
                f"a pixel off {shifted:.3f} at best"
            )
            if overlap < max(OVERLAP, shifted):
                failures.append(f"silhouettes of {scene.scene_id} frame {frame}")
    again = BlenderRenderer(480, 320)
    first, drawn_again, other = (
        np.asarray(r.render(scenes[0], FRAMES[0]), int) for r in (drawn, drawn, again)
    )
    print(f"drawn again: {(first != drawn_again).mean():.1e} of the values differ")
    apart = np.abs(first - other)
    print(f"by another Blender: {(apart > 0).mean():.1e} differ, by {apart.max()} at most")
    if (first != drawn_again).any() or apart.max() > 1 or (apart > 0).mean() > UNEQUAL:
        failures.append("the same pixels again")
    if outlives_its_parent():
        failures.append("a Blender that ends with its parent")
    for width, height in SIZES:
        print(f"{width}x{height}: {seconds_a_frame(width, height, scenes):.2f} s a frame")
    sys.exit("\n".join(f"missed: {failure}" for failure in failures) or None)


def strong(scene: Scene) -> Scene:
    """A scene of at most six objects in colours that no floor or shadow has."""
    looks = tuple(
        SceneObject(look.shape, "rubber", color)
        for look, color in zip(scene.objects, STRONG, strict=False)
    )
    return replace(scene, scene_id=f"{scene.scene_id}-strong", objects=looks)


def agreement(drawn: BlenderRenderer, scene: Scene, frame: int) -> tuple[float, float]:
    """Intersection over union of the objects' silhouettes with what rays hit, and the best of those
    with the rays' picture shifted by a pixel to each side."""
    pixels = np.asarray(drawn.render(scene, frame), float)
    found = np.ptp(pixels, axis=-1) > 0.3 * pixels.max(axis=-1)
    hit = seen(scene, frame, Camera())
    shifts = [np.roll(hit, step, axis) for step in (-1, 1) for axis in (0, 1)]
    overlap, *shifted = [(found & h).sum() / (found | h).sum() for h in (hit, *shifts)]
    return overlap, max(shifted)


def seen(scene: Scene, frame: int, camera: Camera) -> np.ndarray:
    """(H, W) whether a pixel's ray hits an object."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(columns.ravel().astype(float), rows.ravel().astype(float))
    hit = np.zeros(len(rays), bool)
    for k, look in enumerate(scene.objects):
        pose = scene.positions[frame, k], scene.quaternions[frame, k]
        hit |= np.isfinite(hit_depth(look.shape, *pose, np.asarray(camera.eye), rays))
    return hit.reshape(camera.height, camera.width)


def outlives_its_parent() -> bool:
    """Whether a Blender goes on after its parent is killed in the midst of a frame."""
    code = (
        "from benchmarks.speed.blender import *\n"
        "drawn = BlenderRenderer(1920, 1280)\n"
        "print(drawn._worker.pid, flush=True)\n"
        "drawn.render(simulate_scene(0, 0, 'train', BenchmarkConfig(name='blender')), 60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = psutil.Process(int(parent.stdout.readline()))
    time.sleep(2)
    os.kill(parent.pid, signal.SIGKILL)
    try:
        worker.wait(timeout=10)
    except psutil.TimeoutExpired:
        return True
    return False


def seconds_a_frame(width: int, height: int, scenes: list[Scene]) -> float:
    """Median over the scenes' frames, after one unmeasured."""
    drawn = BlenderRenderer(width, height)
    drawn.render(scenes[0], 0)
    times = []
    for scene in scenes:
        for frame in FRAMES:
            started = time.perf_counter()
            drawn.render(scene, frame)
            times.append(time.perf_counter() - started)
    return statistics.median(times)


if __name__ == "__main__":
    main()
