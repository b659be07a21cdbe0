"""Scores of candidates that involve no prediction, and the balance of the target's rank in them.

A strategy that does not predict chooses the candidate with the lowest or highest score. It is right
in a quarter of the items if the target has each of the four ranks equally often.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from PIL import Image

from dynapix.data.frames.frame_cache import render_frames
from dynapix.data.oracle.displacement import (
    MODEL_SIZE,
    cross_scene_displacement,
    object_displacements,
    visible_positions,
)
from dynapix.data.oracle.events import next_collision
from dynapix.data.oracle.extrapolation import extrapolate
from dynapix.data.records import CONTACT, FrameRef, Scene, SelectionItem
from dynapix.data.sim.camera import Camera

SCORES = (
    "nearness", "pixel nearness", "oddness", "pixel oddness", "moment", "travel", "visible", "gap",
)  # fmt: skip
"""Scores of a candidate: displacement from the last observed frame, mean difference of pixels from
it, sums of displacements and of pixel differences from the other candidates, index of the frame,
sum of the displacements of all objects since the last observed frame, number of visible objects,
and the smallest gap between two of them."""
COLLISION_SCORES = ("velocity", "striker", "struck", "deflection", "pair distance")
"""Further scores of the candidates of contact items: mean distance of the objects in the image from
their positions at constant velocity, distances of the two objects of the collision from where they
would meet at constant velocity, angle between the first part of this distance and the velocity of
the faster object (the striker), and distance between the two objects."""
TOUCHING = 0.05
"""Gap (simulator units) below which two objects count as touching."""
APART = 10.0
"""Gap (simulator units) of a frame in which fewer than two objects are visible."""
LIMIT, TOLERANCE = 1.75, 0.015
"""The number of targets with one rank may differ from a quarter of the items by at most
LIMIT + TOLERANCE * items."""
IMAGE_SIZE = 72, 48
"""Width and height in px of the images that are compared by pixels."""
START = 0.75
"""The initial counts are samples from [-START, START], less the mean of each score's four
counts."""


@dataclass(frozen=True)
class CandidateFrames:
    """The last observed frame and frames from which candidates are chosen, as scores need them.

    Attributes:
        displacement: (M, M) displacement between two frames, px at 336 x 336.
        pixels: (M, M) mean difference of pixels.
        single: (S', M) moment, travel, number of visible objects and gap of each frame, and what
            `collision_scores` returns for contact items.
    Frame 0 is the last observed frame.
    """

    displacement: np.ndarray
    pixels: np.ndarray
    single: np.ndarray

    @classmethod
    def compare(
        cls,
        frames: Sequence[tuple[Scene, int]],
        moments: Sequence[int],
        images: np.ndarray,
        further: Sequence[np.ndarray] = (),
    ) -> CandidateFrames:
        """Compare frames, given as scenes and indices, with their indices in time (M,), their
        images (M, H, W, 3) uint8 and further scores of single frames (M,)."""
        displacement = np.zeros((len(frames), len(frames)))
        for a, b in combinations(range(len(frames)), 2):
            distance = cross_scene_displacement(*frames[a], *frames[b])
            displacement[a, b] = displacement[b, a] = distance
        flat = images.reshape(len(images), -1).astype(np.float32)
        single = [
            moments,
            [sum(object_displacements(*frames[0], *frame)) for frame in frames],
            [visible_positions(scene)[1][frame].sum() for scene, frame in frames],
            [_gap(scene, frame) for scene, frame in frames],
            *further,
        ]
        pixels = np.stack([np.abs(flat - image).mean(axis=-1) for image in flat])
        return cls(displacement, pixels, np.array(single, dtype=float))

    def item_scores(self) -> np.ndarray:
        """Return the scores (S, 4) of frames 1 to 4, in the order of `SCORES`."""
        return self.scores(np.array([[1, 2, 3, 4]]))[:, 0]

    def scores(self, candidates: np.ndarray) -> np.ndarray:
        """Return the scores (S, T, 4) of T choices of candidates, (T, 4) indices of frames."""
        one, other = candidates[:, :, None], candidates[:, None, :]
        pairs = self.displacement, self.pixels
        nearness = [each[0, candidates] for each in pairs]
        oddness = [each[one, other].sum(axis=-1) for each in pairs]
        return np.stack([*nearness, *oddness, *self.single[:, candidates]])


def _gap(scene: Scene, frame: int) -> float:
    """Return the smallest gap between two visible objects of a frame, simulator units. Gaps below
    `TOUCHING` count as equal."""
    seen = np.flatnonzero(visible_positions(scene)[1][frame])
    places, radii = scene.positions[frame], scene.object_radii
    gaps = [
        np.linalg.norm(places[a] - places[b]) - (radii[a] + radii[b])
        for a, b in combinations(seen.tolist(), 2)
    ]
    return max(float(min(gaps, default=APART)), TOUCHING)


def collision_scores(
    scene: Scene,
    stop: int,
    moment: int,
    frames: Sequence[tuple[Scene, int]],
    camera: Camera,
) -> np.ndarray:
    """Return the `COLLISION_SCORES` (5, M) of frames that show the objects of a scene at a moment
    after its next collision after frame `stop`."""
    collision = next_collision(scene, stop)
    assert collision is not None
    velocities = scene.velocities[stop, collision.objects, :2]
    pair = np.array(collision.objects)[np.argsort(-np.linalg.norm(velocities, axis=-1))]
    ahead = (collision.frame - stop) / scene.fps
    meeting = extrapolate(scene, stop, ahead)[pair]
    places = np.stack([other.positions[frame, pair] for other, frame in frames])
    moved = (places - meeting)[..., :2]
    travel = np.linalg.norm(moved, axis=-1)
    heading = scene.velocities[stop, pair[0], :2]
    cosine = moved[:, 0] @ heading / np.maximum(travel[:, 0] * np.linalg.norm(heading), 1e-6)
    expected, _ = camera.project(extrapolate(scene, stop, (moment - stop) / scene.fps))
    scale = MODEL_SIZE / np.array(scene.image_size)
    away = np.stack([(other.image_positions[frame] - expected) * scale for other, frame in frames])
    return np.stack(
        [
            np.linalg.norm(away, axis=-1).mean(axis=-1),
            *travel.T,
            np.degrees(np.arccos(np.clip(cosine, -1, 1))),
            np.linalg.norm(places[:, 0] - places[:, 1], axis=-1),
        ]
    )


def nearly_equal(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether scores differ by less than the precision of the stored positions."""
    return np.isclose(one, other, rtol=1e-4, atol=1e-3)


def rank_shares(scores: np.ndarray, candidate: int = 0) -> np.ndarray:
    """Return the distribution (..., 4) of the rank of one of four candidates (..., 4): the number
    of candidates with lower scores. Candidates with equal scores share the ranks."""
    target, others = scores[..., [candidate]], np.delete(scores, candidate, axis=-1)
    close = nearly_equal(others, target)
    lower = (others < target) & ~close
    first, count = lower.sum(axis=-1), close.sum(axis=-1) + 1
    ranks = np.arange(4)
    shared = (ranks >= first[..., None]) & (ranks < (first + count)[..., None])
    return shared / count[..., None]


def compare_candidates(scores: np.ndarray) -> np.ndarray:
    """Return the scores (..., S, 4) of four candidates relative to each other, (..., 3 S, 4): in
    standard deviations from their mean, and whether each is the lowest or the highest."""
    spread = scores.std(axis=-1, keepdims=True)
    relative = (scores - scores.mean(axis=-1, keepdims=True)) / np.maximum(spread, 1e-6)
    is_lowest = nearly_equal(scores, scores.min(axis=-1, keepdims=True))
    is_highest = nearly_equal(scores, scores.max(axis=-1, keepdims=True))
    return np.concatenate([relative, is_lowest, is_highest], axis=-2)


class Balance:
    """Counts how often the targets of a cell have each rank in each score. The counts start near 0
    at random, so that the few items of many small cells do not all begin with the same ranks."""

    def __init__(self, rng: np.random.Generator, names: Sequence[str] = SCORES) -> None:
        self.items = 0
        self.names = names
        start = rng.uniform(-START, START, (len(names), 4))
        self.excess = start - start.mean(axis=-1, keepdims=True)
        """How often the targets have each rank, less how often they would have it by chance."""

    def excess_of(self, score: str) -> np.ndarray:
        """Return the excess of each rank (4,) in a score."""
        return self.excess[self.names.index(score)]

    def choose(
        self,
        scores: np.ndarray,
        eligible: Sequence[int] = (0, 1, 2, 3),
        targets: Sequence[int] = (0,),
    ) -> int | None:
        """Return the choice of candidates that keeps the counts of ranks most even, and count it.

        Args:
            scores: (S, T, 4) scores of T choices; the first of four candidates is the target.
            eligible: The candidates that could be the target as far as their kind tells. By chance,
                the target has the rank of each of them equally often.
            targets: The candidates that are targets. Those of a pair of items are counted together.

        Returns:
            The index of the choice, or None if each would make the count of a rank differ too much
            from its chance (see `LIMIT`) and the counts less even as a whole.
        """
        added = sum(rank_excess(scores, eligible, target) for target in targets)
        excess = self.excess + added.swapaxes(0, 1)
        unevenness = (excess**2).sum(axis=(1, 2))
        # Without the second condition, a cell could reach counts at which it refuses every item.
        bound = LIMIT + TOLERANCE * self.items
        allowed = (np.abs(excess).max(axis=(1, 2)) <= bound) | (unevenness < (self.excess**2).sum())
        if not allowed.any():
            return None
        best = int(np.where(allowed, unevenness, np.inf).argmin())
        self.excess = excess[best]
        self.items += 1
        return best


def rank_excess(
    scores: np.ndarray, eligible: Sequence[int] = (0, 1, 2, 3), target: int = 0
) -> np.ndarray:
    """Return the distribution of the target's rank (see `rank_shares`), less the mean distribution
    of the eligible candidates, (..., 4)."""
    if len(eligible) == 4:
        return rank_shares(scores, target) - 1 / 4
    chance = np.mean([rank_shares(scores, k) for k in eligible], axis=0)
    return rank_shares(scores, target) - chance


def compare_item(
    item: SelectionItem, scene_of: Callable[[str], Scene], config: Mapping[str, Any]
) -> CandidateFrames:
    """Compare the last observed frame and the candidates of an item, in a benchmark's settings."""
    frames = [FrameRef(item.scene_id, item.prefix_stop), *item.candidates]
    states = [(scene_of(f.scene_id), f.frame) for f in frames]
    images = np.concatenate([render_small(scene, [frame], config) for scene, frame in states])
    further: Sequence[np.ndarray] = ()
    if item.distractors == CONTACT:
        camera = Camera.from_settings(config["world"]["camera"])
        own = scene_of(item.scene_id)
        further = [*collision_scores(own, item.prefix_stop, item.target_frame, states, camera)]
    return CandidateFrames.compare(states, [f.frame for f in frames], images, further)


def render_small(scene: Scene, frames: Sequence[int], config: Mapping[str, Any]) -> np.ndarray:
    """Return frames as small images (T, H, W, 3), rendered by Bullet if the scene was simulated."""
    width, height = IMAGE_SIZE
    small = {"renderer": "bullet", "width": width, "height": height}
    images = render_frames(scene, frames, {**config, **small})
    # Releases have frames of other sizes.
    return np.stack([Image.fromarray(images[frame]).resize(IMAGE_SIZE) for frame in frames])


def order_target_first(scores: np.ndarray, answers: np.ndarray) -> np.ndarray:
    """Return scores (N, S, 4) with those of the target, whose index is in `answers`, first."""
    order = np.array([[a, *(k for k in range(4) if k != a)] for a in answers.tolist()])
    return np.take_along_axis(scores, order[:, None, :], axis=-1)
