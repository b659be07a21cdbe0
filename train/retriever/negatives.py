"""What a batch's negatives count for: switches that change the objective on purpose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from data.records import FrameRef
from data.store import Store
from data.world.displacement import frame_displacements


@dataclass(frozen=True)
class Weighing:
    """Which frames of a batch are no negatives of a query, and what its hard negatives weigh.

    `identical` takes out those that are the very frame of its target, `near` those of the target's
    scene that are displaced by less from it (px at 336 x 336). A hard negative counts as often as
    `hard_weight` says in the sum over negatives, others count once.
    """

    store: Store
    identical: bool = False
    near: float = 0.0
    hard_weight: float = 1.0

    @property
    def changes(self) -> bool:
        return self.identical or self.near > 0 or self.hard_weight != 1

    def added(self, documents: Sequence[Sequence[FrameRef]], own: range) -> torch.Tensor:
        """(own, documents, 1 + negatives) what is added to the scores of the queries in `own`.

        `documents` are those of all ranks: each query's target, then its hard negatives.
        """
        added = torch.zeros(len(own), len(documents), len(documents[0]))
        added[range(len(own)), own, 1:] = math.log(self.hard_weight)
        places: dict[str, list[tuple[int, int]]] = {}
        for row, frames in enumerate(documents):
            for column, frame in enumerate(frames):
                places.setdefault(frame.scene_id, []).append((row, column))
        for query, row in enumerate(own):
            target = documents[row][0]
            for place in places[target.scene_id]:
                if place != (row, 0) and self._is_target(target, documents[place[0]][place[1]]):
                    added[query][place] = -math.inf
        return added

    def _is_target(self, target: FrameRef, frame: FrameRef) -> bool:
        """Whether a frame of the target's scene counts as the target."""
        if frame.frame == target.frame:
            return self.identical or self.near > 0
        if not self.near:
            return False
        scene = self.store.scene(target.scene_id)
        return bool(frame_displacements(scene)[target.frame, frame.frame] < self.near)
