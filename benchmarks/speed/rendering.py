"""Frames a second that a build's worker draws and encodes, beside what Bullet's rasteriser does
alone in the same run.

    python -m benchmarks.speed.rendering
    python -m benchmarks.speed.rendering --workers 2

The rasteriser's own rate is `getCameraImage` over the same scenes and frames, at the size that it
is asked for: twice the frame's, to be averaged. A worker's rate has everything: loading scenes,
posing, `getCameraImage`, floor and shadows, averaging, and writing the archive of each scene.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from conf.schema import BenchmarkConfig
from data.parallel import Workers
from data.records import FRAMES, Scene
from data.render.bullet import BulletRenderer
from data.render.frame_cache import save_frames
from data.world.sampling import simulate_scene

SIZES = ((192, 128), (240, 160), (480, 320))
STRIDE = 2
"""Every second frame of a scene is drawn: 64, about as many as a benchmark names."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Time the rendering of frames.")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds, after one unmeasured")
    parser.add_argument("--workers", type=int, default=1, help="processes that draw at once")
    args = parser.parse_args()
    print(f"{'':<10}{'rasteriser/s':>14}{'worker/s':>10}{'ratio':>8}{'KB/frame':>11}")
    for width, height in SIZES:
        job = partial(measure, width, height, args.scenes, args.rounds)
        jobs = {str(k): job for k in range(args.workers)}
        done = Workers(args.workers).run(jobs, f"{width}x{height}", "worker")
        measured = zip(*(rates for _, rates in done), strict=True)
        alone, whole, ratio, size = map(statistics.median, measured)
        name = f"{width}x{height}"
        print(f"{name:<10}{alone:>14.0f}{whole:>10.0f}{ratio:>8.0%}{size / 1e3:>11.1f}")


def measure(width: int, height: int, scenes: int, rounds: int) -> tuple[float, float, float, float]:
    """Frames a second of the rasteriser alone and of the whole, their ratio, and bytes a frame: the
    medians of the rounds."""
    drawn = BulletRenderer(width, height)
    limits = BenchmarkConfig(name="rendering")
    asked = [simulate_scene(0, k, "train", limits) for k in range(scenes)]
    frames = [(scene, frame) for scene in asked for frame in range(0, FRAMES, STRIDE)]
    rows = []
    for _ in range(rounds + 1):
        alone = rasterise_all(drawn, frames)
        started = time.perf_counter()
        written = draw_and_keep(drawn, asked)
        whole = time.perf_counter() - started
        count = len(frames)
        rows.append((count / alone, count / whole, alone / whole, written / count))
    alone, whole, ratio, size = map(statistics.median, zip(*rows[1:], strict=True))
    return alone, whole, ratio, size


def draw_and_keep(drawn: BulletRenderer, scenes: list[Scene]) -> int:
    """Draw the frames of scenes and write them; bytes written."""
    written = 0
    with tempfile.TemporaryDirectory() as folder:
        for scene in scenes:
            path = Path(folder) / f"{scene.scene_id}.zip"
            pixels = {f: np.asarray(drawn.render(scene, f)) for f in range(0, FRAMES, STRIDE)}
            save_frames(pixels, path)
            written += path.stat().st_size
    return written


def rasterise_all(drawn: BulletRenderer, frames: list[tuple[Scene, int]]) -> float:
    """Seconds in getCameraImage over frames."""
    seconds = 0.0
    for frame in frames:
        drawn.pose(*frame)
        started = time.perf_counter()
        drawn.photograph()
        seconds += time.perf_counter() - started
    return seconds


if __name__ == "__main__":
    main()
