"""How long a training sample's frames take to read from the cache of rendered frames.

    python -m benchmarks.speed.reading

A scene is rendered whole at 480 x 320 px and kept; then 16 of its frames (12 of a prefix, and four
candidates) are read as a model is shown them, 336 x 336 px, nothing of them in memory but what the
operating system keeps of the file. The peer is the same frames kept as PNGs and resized by Pillow.
Medians of 30 runs, one thread.
"""

from __future__ import annotations

import io
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from PIL import Image

from conf.schema import BenchmarkConfig
from data.render.frame_cache import FrameCache, Frames, load_frames, save_frames
from data.store import save_scene, scene_path
from data.world.sampling import simulate_scene

RUNS = 30
SIZE = 336


def median_ms(job: Callable[[], object]) -> float:
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        job()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def main() -> None:
    torch.set_num_threads(1)
    scene = simulate_scene(0, 3, "train", BenchmarkConfig(name="reading"))
    shown = [*range(10, 58, 4), 70, 80, 90, 100]
    with tempfile.TemporaryDirectory() as folder:
        config = {
            "width": 480,
            "height": 320,
            "renderer": "bullet",
            "simulator": "bullet",
            "folder": None,
        }
        store = SimpleNamespace(folder=Path(folder), manifest={"config": config})
        save_scene(scene, scene_path(store.folder, scene.scene_id))
        cache = FrameCache.of(store)
        path = cache.path(scene.scene_id)
        save_frames(cache.draw(scene.scene_id, list(range(scene.frames))), path)
        pngs = []
        for pixels in load_frames(path, shown).values():
            png = io.BytesIO()
            Image.fromarray(pixels).save(png, "PNG", compress_level=1)
            pngs.append(png.getvalue())
        ours = median_ms(lambda: Frames(store, SIZE).stack(scene.scene_id, shown))
        decoded = median_ms(lambda: load_frames(path, shown))
        peer = median_ms(
            lambda: [
                np.asarray(Image.open(io.BytesIO(png)).convert("RGB").resize((SIZE, SIZE)))
                for png in pngs
            ]
        )
        each = path.stat().st_size / scene.frames
        print(f"{len(shown)} frames of 480 x 320 px, shown at {SIZE} x {SIZE}")
        print(f"from the cache    {ours:6.1f} ms, of which decoding {decoded:.1f} ms")
        print(f"as PNGs           {peer:6.1f} ms, {peer / ours:.1f} times as long")
        png_each = sum(map(len, pngs)) / len(pngs)
        print(f"a frame on disk   {each / 1e3:6.1f} KB, as PNG {png_each / 1e3:.1f} KB")


if __name__ == "__main__":
    main()
