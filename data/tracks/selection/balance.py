"""Scores of candidates that involve no prediction, and the balance of the target's rank in them.

A strategy without foresight chooses the candidate with the lowest or highest score. It is right in
a quarter of the items if the target has each of the four ranks equally often.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data.records import Scene
from data.world.displacement import frame_displacements, visible_positions

SCORES = (
    "nearness", "pixel_nearness", "oddness", "pixel_oddness", "moment", "travel", "visible",
)  # fmt: skip
"""Scores of a candidate: displacement from the last observed frame, mean difference of pixels from
it, sums of displacements and of pixel differences from the other candidates, index of the frame,
sum of the displacements of all objects since the last observed frame, number of visible objects."""
LIMIT, TOLERANCE = 1.75, 0.015
"""The count of targets of a rank may differ from a quarter of all items by `LIMIT`, and by this
share of the items. Without the second term, a cell could reach counts that no item improves."""
START = 0.75
"""Maximum distance from 0 of the counts at the start."""


@dataclass(frozen=True)
class Pool:
    """Frames from which the candidates of an item are chosen, and what the scores need of them.

    Attributes:
        displacement: (M, M) displacement between two frames, px at 336 x 336.
        pixels: (M, M) mean difference of pixels.
        moment: (M,) index of the frame in its scene.
        travel: (M,) sum of the displacements of the objects since frame 0.
        visible: (M,) number of visible objects.
    Frame 0 is the last observed frame.
    """

    displacement: np.ndarray
    pixels: np.ndarray
    moment: np.ndarray
    travel: np.ndarray
    visible: np.ndarray

    @classmethod
    def of(cls, scene: Scene, images: np.ndarray, moment: np.ndarray) -> Pool:
        """Return the pool of all frames of a scene, whose images are (M, H, W, 3) uint8."""
        positions, visible = visible_positions(scene)
        shift = np.linalg.norm(positions - positions[0], axis=-1)
        flat = images.reshape(len(images), -1).astype(np.float32)
        return cls(
            frame_displacements(scene),
            np.abs(flat[:, None] - flat[None]).mean(axis=-1),
            moment,
            np.where(visible | visible[0], shift, 0.0).sum(axis=-1),
            visible.sum(axis=-1),
        )

    def scores(self, candidates: np.ndarray) -> np.ndarray:
        """Return the scores (S, T, 4) of T choices of candidates, (T, 4) indices of frames."""
        one, other = candidates[:, :, None], candidates[:, None, :]
        return np.stack(
            [
                self.displacement[0, candidates],
                self.pixels[0, candidates],
                self.displacement[one, other].sum(axis=-1),
                self.pixels[one, other].sum(axis=-1),
                self.moment[candidates],
                self.travel[candidates],
                self.visible[candidates],
            ]
        )


def rank_shares(scores: np.ndarray) -> np.ndarray:
    """Return the distribution (..., 4) of the rank of the first of four candidates (..., 4).

    The rank is the number of candidates with lower scores; candidates with equal scores share the
    ranks.
    """
    target, others = scores[..., :1], scores[..., 1:]
    # Differences below the precision of the stored positions count as none.
    close = np.isclose(others, target, rtol=1e-4, atol=1e-3)
    lower = (others < target) & ~close
    first, count = lower.sum(axis=-1), close.sum(axis=-1) + 1
    ranks = np.arange(4)
    shared = (ranks >= first[..., None]) & (ranks < (first + count)[..., None])
    return shared / count[..., None]


class Balance:
    """Counts how often the targets of a cell have each rank in each score.

    The counts start at random values near 0, so that the few items of many small cells do not all
    begin with the same ranks.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.items = 0
        start = rng.uniform(-START, START, (len(SCORES), 4))
        self.counts = start - start.mean(axis=-1, keepdims=True)

    def rarest_rank(self, score: str) -> int:
        """Return the rank that the fewest targets have in a score."""
        return int(self.counts[SCORES.index(score)].argmin())

    def choose(self, scores: np.ndarray) -> int | None:
        """Return the choice of candidates that keeps the ranks most even, and count it.

        Args:
            scores: (S, T, 4) scores of T choices; the first of four candidates is the target.

        Returns:
            The index of the choice, or None if each would make the count of a rank differ too much
            from a quarter of the items (see `LIMIT`).
        """
        shares = rank_shares(scores).swapaxes(0, 1)
        excess = self.counts + shares - (self.items + 1) / 4
        best = int((excess**2).sum(axis=(1, 2)).argmin())
        if np.abs(excess[best]).max() > LIMIT + TOLERANCE * self.items:
            return None
        self.counts = self.counts + shares[best]
        self.items += 1
        return best
