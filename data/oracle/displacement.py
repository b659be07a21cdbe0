"""Displacement of objects in the image between frames, computed from the oracle alone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dynapix.conf.schema.benchmark import MODEL_SIZE
from dynapix.data.oracle.visibility import is_hidden
from dynapix.data.records import Scene, SceneObject

DIAGONAL = MODEL_SIZE * 2**0.5


@lru_cache(maxsize=64)
def visible_positions(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (F, N, 2), px at 336 x 336, and whether each object is visible (F, N): its
    centre is on screen, and no other objects hide it."""
    positions = scene.image_positions * (MODEL_SIZE / np.array(scene.image_size))
    inside = (positions >= 0).all(-1) & (positions <= MODEL_SIZE).all(-1)
    visible = scene.in_view & inside & ~is_hidden(scene)
    for shared in (positions, visible):
        shared.setflags(write=False)
    return positions, visible


@lru_cache(maxsize=64)
def frame_displacements(scene: Scene, subjects: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the largest displacement of an object of `subjects` (indices; all by default) between
    any two frames, (F, F) px at 336 x 336.

    Only objects that are visible (see `visible_positions`) in at least one of the two frames count,
    because the edge of an object on the border of the image, or an object behind another one, does
    not suffice to distinguish frames. The image's diagonal is the maximum.
    """
    positions, visible = visible_positions(scene)
    if subjects is not None:
        positions, visible = positions[:, subjects], visible[:, subjects]
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    counts = visible[:, None] | visible[None]
    return np.minimum(np.where(counts, distance, 0.0).max(axis=-1, initial=0.0), DIAGONAL)


def cross_scene_displacement(scene: Scene, frame: int, other: Scene, other_frame: int) -> float:
    """Return the largest displacement of an object between frames of two scenes, px at 336 x 336.

    As in `frame_displacements`, but with objects matched by appearance. An object that is visible
    in one scene and does not exist in the other counts as displaced by the image's diagonal.
    """
    return min(max(object_displacements(scene, frame, other, other_frame), default=0.0), DIAGONAL)


def object_displacements(scene: Scene, frame: int, other: Scene, other_frame: int) -> list[float]:
    """Return the displacement of each object that is visible in at least one of two frames, px at
    336 x 336; the image's diagonal for an object that one of the scenes lacks."""
    first = _positions_by_appearance(scene, frame)
    second = _positions_by_appearance(other, other_frame)
    displacements = []
    for key in first | second:
        position, visible = first.get(key, (None, False))
        other_position, other_visible = second.get(key, (None, False))
        if visible or other_visible:
            is_shared = position is not None and other_position is not None
            distance = float(np.linalg.norm(position - other_position)) if is_shared else DIAGONAL
            displacements.append(distance)
    return displacements


def distances_from(expected: np.ndarray, scene: Scene, other: Scene, frame: int) -> np.ndarray:
    """Return the distances (..., N) of the objects of a scene in a frame of another one from their
    expected image positions (..., N, 2), px at 336 x 336. The image's diagonal is the maximum, also
    for an object that the other scene lacks."""
    places = other.image_positions[frame] * (MODEL_SIZE / np.array(other.image_size))
    actual = dict(zip(other.object_keys, places, strict=True))
    found = np.stack([actual.get(key, np.full(2, np.inf)) for key in scene.object_keys])
    return np.minimum(np.linalg.norm(expected - found, axis=-1), DIAGONAL)


@lru_cache(maxsize=256)
def _positions_by_appearance(
    scene: Scene, frame: int
) -> dict[tuple[SceneObject, int], tuple[np.ndarray, bool]]:
    """Map appearances, numbered where objects look alike, to positions and whether visible."""
    positions, visible = visible_positions(scene)
    return {
        key: (positions[frame, k], bool(visible[frame, k]))
        for k, key in enumerate(scene.object_keys)
    }


def object_match_scores(
    scene: Scene, target: int, subjects: tuple[int, ...] | None = None
) -> np.ndarray:
    """Return the object-match score of each frame with frame `target`, (F,); lower is more similar.

    The score is the mean displacement of the objects of `subjects` (indices; all by default) in the
    image, as a fraction of the image's diagonal. An object that is in view in only one of the
    frames counts as 1; in neither, as 0.
    """
    distance = np.linalg.norm(scene.image_positions - scene.image_positions[target], axis=-1)
    share = np.minimum(distance / np.hypot(*scene.image_size), 1.0)
    in_view, target_in_view = scene.in_view, scene.in_view[target]
    scores = np.where(in_view & target_in_view, share, in_view ^ target_in_view)
    return (scores if subjects is None else scores[:, subjects]).mean(axis=-1)
