"""Image-plane displacement between frames, computed from the oracle alone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from data.records import Scene, SceneObject

MODEL_SIZE = 336
"""Side in px of the square image that displacements are measured in."""
DIAGONAL = MODEL_SIZE * 2**0.5


def on_screen_positions(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """(F, N, 2) where objects stand in px at 336 x 336, and (F, N) whether their centre shows."""
    places = scene.image_positions * (MODEL_SIZE / np.array(scene.image_size))
    inside = (places >= 0).all(-1) & (places <= MODEL_SIZE).all(-1)
    return places, scene.in_view & inside


@lru_cache(maxsize=64)
def frame_displacements(scene: Scene, about: tuple[int, ...] | None = None) -> np.ndarray:
    """(F, F) how far two frames of a scene are apart: the largest image displacement between them
    of an object (of one in `about`, where that is given), px at 336 x 336, the image's diagonal at
    most.

    An object counts where its centre is on screen in at least one of the two frames, so that a
    sliver at the edge tells no frames apart.
    """
    places, shown = on_screen_positions(scene)
    if about is not None:
        places, shown = places[:, about], shown[:, about]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    counts = shown[:, None] | shown[None]
    return np.minimum(np.where(counts, apart, 0.0).max(axis=-1, initial=0.0), DIAGONAL)


def cross_scene_displacement(scene: Scene, frame: int, other: Scene, other_frame: int) -> float:
    """How far frames of two scenes are apart: as `displacements` over objects that look alike. One
    that shows and is in only one of the scenes makes them as far apart as can be."""
    here, there = _shown_at(scene, frame), _shown_at(other, other_frame)
    apart = 0.0
    for look in here.keys() | there.keys():
        (place, shown), (other_place, other_shown) = (
            side.get(look, (np.full(2, np.inf), False)) for side in (here, there)
        )
        if shown or other_shown:
            apart = max(apart, float(np.linalg.norm(place - other_place)))
    return min(apart, DIAGONAL)


def _shown_at(scene: Scene, frame: int) -> dict[tuple[SceneObject, int], tuple[np.ndarray, bool]]:
    """Where each object is and whether it shows, by its look and which of those that look so."""
    places, shown = on_screen_positions(scene)
    return {
        (look, scene.objects[:k].count(look)): (places[frame, k], bool(shown[frame, k]))
        for k, look in enumerate(scene.objects)
    }


def object_match_scores(
    scene: Scene, target: int, about: tuple[int, ...] | None = None
) -> np.ndarray:
    """(F,) how unlike `target` each frame of a scene looks, 0 for itself: the mean over objects
    (those in `about`, where that is given) of the image-plane displacement as a share of the
    image's diagonal, where an object in view in only one of the two counts as 1 and one in view in
    neither as 0."""
    apart = np.linalg.norm(scene.image_positions - scene.image_positions[target], axis=-1)
    share = np.minimum(apart / np.hypot(*scene.image_size), 1.0)
    seen, seen_too = scene.in_view, scene.in_view[target]
    unlike = np.where(seen & seen_too, share, seen ^ seen_too)
    return (unlike if about is None else unlike[:, about]).mean(axis=-1)
