"""The order of training samples: random over an epoch, by length within a step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch.utils.data import Sampler


@dataclass(eq=False)
class LengthSampler(Sampler[int]):
    """Yields all samples in a random order per epoch, those of a step sorted by length.

    Sorting keeps the padding of a micro-batch small. The samples of a step do not depend on how it
    is split into micro-batches and ranks.

    Ranks take one micro-batch each in turn, and the order of the ranks alternates, so that no rank
    always has the longest. If the last step of an epoch cannot be shared evenly, it is filled up
    with unsupervised samples (negative indices of `StudentDataset`).

    Attributes:
        lengths: Of all samples.
        batch: Samples of a step, over all its micro-batches and ranks.
    """

    lengths: Sequence[int]
    batch: int
    seed: int
    micro_batch: int = 1
    world_size: int = 1
    epoch: int = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return len(self.lengths) + self._missing(len(self.lengths) % self.batch)

    def __iter__(self) -> Iterator[int]:
        order = np.random.default_rng([self.seed, self.epoch]).permutation(len(self.lengths))
        lengths = np.asarray(self.lengths)
        for start in range(0, len(order), self.batch):
            step = order[start : start + self.batch]
            # The longest first, so that running out of memory shows at the start of a run.
            step = step[np.argsort(-lengths[step], kind="stable")]
            yield from self._deal(step).tolist()

    def _deal(self, step: np.ndarray) -> np.ndarray:
        """Order a step's samples, longest first, as the ranks take them."""
        fillers = np.repeat(~step[-1:], self._missing(len(step)))
        rounds = np.append(step, fillers)
        if self.world_size > 1:
            rounds = rounds.reshape(-1, self.world_size, self.micro_batch)
            rounds[1::2] = rounds[1::2, ::-1]
        return rounds.ravel()

    def _missing(self, samples: int) -> int:
        """Return how many samples a step of this size lacks to give all ranks equal work."""
        each_round = self.micro_batch * self.world_size
        return -samples % each_round if self.world_size > 1 else 0
