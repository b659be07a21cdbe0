"""Interventions: which object of a scene is removed, and what its absence changes."""

from __future__ import annotations

import numpy as np

from dynapix.data.oracle.displacement import DIAGONAL, visible_positions
from dynapix.data.records import COUNTERFACTUAL, FPS, Scene
from dynapix.data.seeded_order import named_rng

LATEST_STOP = 2 * FPS
"""Maximum index of the last frame of a prefix."""


def removed_object(scene: Scene, seed: int) -> int | None:
    """Sample the object to remove among those that are visible at the end of a prefix of at
    least a second before their first contact. Return its index; None if there is no such object."""
    stops = {k: last_factual_frame(scene, k) for k in range(len(scene.objects))}
    visible = visible_positions(scene)[1]
    eligible = [k for k, stop in stops.items() if stop is not None and visible[stop, k]]
    if not eligible:
        return None
    return int(named_rng(seed, "removed", scene.scene_id).choice(eligible))


def counterfactual_id(scene_id: str, removed: int) -> str:
    """Return the id of the counterfactual scene without object `removed`."""
    return f"{scene_id}{COUNTERFACTUAL}{removed}"


def last_factual_frame(scene: Scene, removed: int) -> int | None:
    """Return the last frame of the prefix: before the first contact of object `removed`, at most
    `LATEST_STOP`. None if the prefix would end before frame `FPS`."""
    contacts = [c.frame for c in scene.collisions if removed in c.objects]
    stop = min(LATEST_STOP, contacts[0] - 1) if contacts else -1
    return stop if stop >= FPS else None


def removal_displacements(scene: Scene, counterfactual: Scene, removed: int) -> np.ndarray:
    """Return the displacement of each object by the removal, (F, N) px at 336 x 336: 0 for the
    removed object, and for objects that are not visible in the counterfactual frame."""
    positions, visible = visible_positions(scene)
    others = [k for k in range(len(scene.objects)) if k != removed]
    other_positions, other_visible = visible_positions(counterfactual)
    distance = np.linalg.norm(positions[:, others] - other_positions, axis=-1)
    shifts = np.zeros(visible.shape)
    shifts[:, others] = np.where(other_visible, distance, 0.0)
    return np.minimum(shifts, DIAGONAL)
