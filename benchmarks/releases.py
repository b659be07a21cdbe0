"""Compares CLEVRER's annotations, as they are read, with the videos of the release.

    python -m benchmarks.releases FOLDER [--every 8]

Prints for each scene the overlap (intersection over union) of the objects' projected silhouettes
with the pixels of the video that differ from the background, by shape, and the ratio of
displacements between frames to velocities, which is 1 if both have the same unit of time.

The background is the median over all frames of all scenes in which no object is near the pixel, so
a folder should have two scenes or more. Shadows count as background up to a difference of
`FOREGROUND`.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict
from itertools import combinations
from pathlib import Path

import numpy as np

from benchmarks.arguments import positive_int
from dynapix.data.records import Scene
from dynapix.data.sim.camera import Camera, pixel_rays
from dynapix.data.sim.shapes import intersect_object, rotation_matrix
from dynapix.data.sources import clevrer

FOREGROUND = 30
"""Least difference from the background, of 255, in one of the channels."""
NEAR = 0.45
"""Radius of a sphere (simulator units) that contains an object and most of its shadow."""
MIN_SPEED = 0.3
"""Least speed of the frames that the ratio is measured in, simulator units per second."""
CAMERA = Camera()


def near(scene: Scene, frame: int, index: int) -> np.ndarray:
    """Return the pixels (H, W) near an object, whatever its orientation."""
    centre, depth = CAMERA.project(scene.positions[frame, index].astype(float))
    if depth <= NEAR:
        return np.zeros((CAMERA.height, CAMERA.width), bool)
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    return np.hypot(x - centre[0], y - centre[1]) < CAMERA.focal * NEAR / depth


def silhouette(scene: Scene, frame: int, index: int) -> np.ndarray:
    """Return the pixels (H, W) that an object covers alone."""
    turn = rotation_matrix(scene.quaternions[frame, index].astype(float))
    eye = (np.asarray(CAMERA.eye) - scene.positions[frame, index]) @ turn
    rays = pixel_rays(CAMERA).reshape(-1, 3) @ turn
    shape, scale = scene.objects[index].shape, scene.object_scales[index]
    return np.isfinite(intersect_object(shape, scale, eye, rays)).reshape(CAMERA.height, -1)


def find_background(videos: list[tuple[Scene, dict[int, np.ndarray]]]) -> np.ndarray:
    """Return the image (H, W, 3) without objects; NaN where an object is always near."""
    free = []
    for scene, images in videos:
        for frame, image in images.items():
            covered = np.any([near(scene, frame, k) for k in range(len(scene.objects))], axis=0)
            free.append(np.where(covered[..., None], np.nan, image))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that are never free
        return np.nanmedian(free, axis=0)


def measure_overlap(
    scene: Scene, images: dict[int, np.ndarray], background: np.ndarray
) -> dict[str, float]:
    """Return the overlap of silhouettes and foreground of the objects that no other is near, by
    shape and of all."""
    counts: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(2))
    for frame, image in images.items():
        differs = np.abs(image - background).max(axis=-1) > FOREGROUND
        areas = [near(scene, frame, k) for k in range(len(scene.objects))]
        meets = {k for a, b in combinations(range(len(areas)), 2)
                 if (areas[a] & areas[b]).any() for k in (a, b)}  # fmt: skip
        for k, area in enumerate(areas):
            is_whole = not (area[0] | area[-1]).any() and not area[:, [0, -1]].any()
            if k in meets or not area.any() or not is_whole or np.isnan(background[area]).any():
                continue
            shape, seen = silhouette(scene, frame, k), differs & area
            for name in (scene.objects[k].shape, "all"):
                counts[name] += (shape & seen).sum(), (shape | seen).sum()
    return {name: float(same / either) for name, (same, either) in sorted(counts.items())}


def velocity_ratio(scene: Scene) -> float:
    """Return the median ratio of displacement per second, along the velocity, to the velocity."""
    moved = (scene.positions[2:] - scene.positions[:-2]) * scene.fps / 2
    velocities = scene.velocities[1:-1]
    squares = (velocities**2).sum(axis=-1)
    moves = squares > MIN_SPEED**2
    return float(np.median((moved * velocities).sum(axis=-1)[moves] / squares[moves]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="CLEVRER's release, or a part of it")
    parser.add_argument("--every", type=positive_int, default=8, help="measure every n-th frame")
    args = parser.parse_args()
    scenes = [clevrer.read_scene(p, args.folder, "test") for p in clevrer.list_scenes(args.folder)]
    videos = []
    for scene in scenes:
        images = clevrer.load_images(scene, args.folder, range(0, scene.frames, args.every))
        videos.append((scene, {f: np.asarray(image, float) for f, image in images.items()}))
    background = find_background(videos)
    for scene, images in videos:
        overlap = measure_overlap(scene, images, background)
        shapes = ", ".join(f"{name} {value:.3f}" for name, value in overlap.items())
        print(f"{scene.scene_id}: overlap {shapes}; velocity ratio {velocity_ratio(scene):.4f}")


if __name__ == "__main__":
    main()
