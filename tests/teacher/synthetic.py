"""Scenes without a simulator: objects at constant velocity in front of a pinhole camera."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np

from dynapix.data.records import (
    COLORS,
    FPS,
    FRAMES,
    MATERIALS,
    SHAPES,
    Candidate,
    Collision,
    Scene,
    SceneObject,
    SelectionItem,
)

EYE = np.array([4.3301, 0.0, 2.5])
FOCAL, CENTRE = 525.0, np.array([240.0, 160.0])
KINDS = [SceneObject(*kind) for kind in product(SHAPES, MATERIALS, COLORS)]


def axes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit vectors to the right, down and forward of the camera."""
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return right, np.cross(forward, right), forward


def project(points: np.ndarray) -> np.ndarray:
    """Return the pixels (x, y) of points in the scene."""
    right, down, forward = axes()
    seen = points - EYE
    depth = np.maximum(seen @ forward, 0.1)
    return np.stack([seen @ right, seen @ down], -1) / depth[..., None] * FOCAL + CENTRE


def on_ground(pixel: tuple[float, float]) -> np.ndarray:
    """Return the point on the ground that is seen at a pixel."""
    right, down, forward = axes()
    x, y = (np.asarray(pixel) - CENTRE) / FOCAL
    ray = forward + x * right + y * down
    return EYE - ray * EYE[2] / ray[2]


def scene(
    starts: list,
    velocities: list,
    *,
    kinds: list[SceneObject] | None = None,
    scene_id: str = "scene",
    frames: int = FRAMES,
) -> Scene:
    """Return a scene with objects that start at `starts` (x, y) and move at `velocities` (units/s).
    They pass through each other; the collision of a pair is recorded at the first frame in which
    its distance is at most 0.4."""
    start, velocity = (np.array(a, dtype=float).reshape(-1, 2) for a in (starts, velocities))
    count = len(start)
    time = np.arange(frames)[:, None, None] / FPS
    positions = np.zeros((frames, count, 3))
    positions[:, :, :2] = start + time * velocity
    velocities3 = np.zeros_like(positions)
    velocities3[:, :, :2] = velocity
    pixels = project(positions)
    in_view = ((pixels >= 0) & (pixels < [480, 320])).all(-1)
    collisions = []
    for i, j in combinations(range(count), 2):
        near = np.linalg.norm(positions[:, i] - positions[:, j], axis=-1) <= 0.4
        if near.any():
            frames_near = np.flatnonzero(near).tolist()
            collisions.append(Collision(frames_near[0], (i, j), frames_near[-1]))
    quaternions = np.zeros((frames, count, 4))
    quaternions[..., 3] = 1
    return Scene(
        scene_id=scene_id,
        split="train",
        objects=tuple(kinds or KINDS[:count]),
        collisions=tuple(sorted(collisions, key=lambda c: c.frame)),
        positions=positions,
        quaternions=quaternions,
        velocities=velocities3,
        angular_velocities=np.zeros_like(positions),
        image_positions=pixels,
        in_view=in_view,
        visible_fraction=in_view.astype(float),
    )


def random_scene(rng: np.random.Generator, scene_id: str = "scene") -> Scene:
    """Return a scene with two to six objects, of which about 60% move."""
    count = int(rng.integers(2, 7))
    kinds = [KINDS[i] for i in rng.permutation(len(KINDS))[:count]]
    speeds = rng.uniform(0, 2.5, (count, 1)) * (rng.random((count, 1)) < 0.6)
    angles = rng.uniform(0, 2 * np.pi, count)
    headings = np.stack([np.cos(angles), np.sin(angles)], -1)
    starts = rng.uniform(-2.5, 2.5, (count, 2))
    return scene(list(starts), list(speeds * headings), kinds=kinds, scene_id=scene_id)


def item(
    frames: tuple[int, int, int, int],
    *,
    start: int = 10,
    stop: int = 30,
    answer: int = 0,
    scene_ids: dict[int, str] | None = None,
    item_id: str = "item",
    framing: str | None = None,
    scene_id: str = "scene",
    split: str = "train",
) -> SelectionItem:
    """Return an item with a candidate at each of `frames`. `scene_ids` has the scene of each
    candidate, by position, that is not from the scene of the item."""
    foreign = scene_ids or {}
    return SelectionItem(
        item_id=item_id,
        split=split,
        suite="dynapix",
        family="event",
        subtype="made",
        question="Which image is closest to the correct future state of the whole scene?",
        scene_id=scene_id,
        prefix_start=start,
        prefix_stop=stop,
        target_frame=frames[answer],
        candidates=tuple(
            Candidate(foreign.get(i, scene_id), frame, "target" if i == answer else "same_time")
            for i, frame in enumerate(frames)
        ),
        answer=answer,
        min_displacement=12.0,
        framing=framing,
    )
