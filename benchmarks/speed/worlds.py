"""Measures how long scenes and frames of each world take, beside those of CLEVRER's world.

    python -m benchmarks.speed.worlds --repeats 3 --sheet docs/worlds.webp

Each repeat simulates the same number of scenes in every world and renders frames of some, in one
process, one scene of each world after the other. The table has the medians of the CPU time: scenes
per second, frames per second, and their ratios to the world `clevrer` of the same repeat. `--sheet`
also draws the first scene of each world, at six moments.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

from benchmarks.arguments import positive_int
from dynapix.conf.compose import compose, list_presets
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import BuildCommand, WorldConfig
from dynapix.data.records import Scene
from dynapix.data.render.bullet import BulletRenderer
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sources.scenes import record_scene

SIZE = 240, 160
"""Width and height of the rendered frames, px."""
MOMENTS = 6
"""Frames of a scene on the sheet."""
RENDERED, RENDERED_SCENES = 25, 8
"""Frames of a scene that are rendered for the measurement, and the number of such scenes."""
WORLDS = list_presets("data.build", BuildCommand)["world"]


def preset_world(name: str) -> WorldConfig:
    """Return the world of a preset. Its benchmark's recipe plays no part in the scenes."""
    overrides = [f"world={name}", "benchmark=standin_movi_a"]
    return compose("data.build", BuildCommand, overrides).benchmark.world


def simulate(world: WorldConfig, seed: int, index: int) -> Scene:
    """Simulate a scene of a world."""
    name = f"{world.name}-{seed}-{index}"
    return record_scene(name, "train", sample_scene(world, seed, index), world)


def measure(scene_count: int, seed: int) -> dict[str, np.ndarray]:
    """Simulate scenes and render frames of some, of all worlds in turn, so that changes of the
    machine's speed concern all worlds alike.

    Returns:
        For each world, the CPU seconds per scene and per frame.
    """
    worlds = {name: preset_world(name) for name in WORLDS}
    renderers = {name: BulletRenderer(*SIZE, world) for name, world in worlds.items()}
    seconds = {name: np.zeros(2) for name in worlds}
    counts = scene_count, RENDERED * min(scene_count, RENDERED_SCENES)
    for index in range(scene_count):
        for name, world in worlds.items():
            start = time.process_time()
            scene = simulate(world, seed, index)
            seconds[name][0] += time.process_time() - start
            if index < RENDERED_SCENES:
                start = time.process_time()
                for frame in moments(scene, RENDERED):
                    renderers[name].render(scene, frame)
                seconds[name][1] += time.process_time() - start
    return {name: spent / counts for name, spent in seconds.items()}


def moments(scene: Scene, count: int) -> list[int]:
    """Return the indices of evenly spaced frames."""
    return np.linspace(0, scene.frames - 1, count).astype(int).tolist()


def draw_sheet(path: Path, seed: int) -> None:
    """Draw the first scene of each world, a row for each."""
    rows = []
    for name in WORLDS:
        world = preset_world(name)
        scene = simulate(world, seed, 0)
        renderer = BulletRenderer(*SIZE, world)
        images = [renderer.render(scene, frame) for frame in moments(scene, MOMENTS)]
        rows.append(np.concatenate([np.asarray(image) for image in images], axis=1))
    Image.fromarray(np.concatenate(rows)).save(path, quality=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=positive_int, default=20)
    parser.add_argument("--repeats", type=positive_int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sheet", type=Path)
    args = parser.parse_args()
    if args.sheet:
        draw_sheet(args.sheet, args.seed)
    measured = defaultdict(list)
    for repeat in range(args.repeats):
        seconds = measure(args.scenes, args.seed + repeat)
        for name, pair in seconds.items():
            measured[name].append([*1 / pair, *seconds["clevrer"] / pair])
    columns = ["scenes/s", "frames/s", "scenes, ratio", "frames, ratio"]
    medians = {name: np.median(values, axis=0) for name, values in measured.items()}
    print(pd.DataFrame.from_dict(medians, "index", columns=columns).round(2).to_string())


if __name__ == "__main__":
    with report_failures():
        main()
