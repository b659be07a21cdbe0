"""The order of training samples: random within an epoch, sorted by length within a step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch.utils.data import Sampler


@dataclass(eq=False)
class LengthSampler(Sampler[int]):
    """Yields the indices of all samples in random order; those of each step are sorted by length.

    Sorting keeps the padding of micro-batches small. Which samples a step has depends neither on
    the size of the micro-batches nor on the number of ranks.

    accelerate gives consecutive micro-batches to the ranks in turn. Every other round is reversed,
    so that no rank always gets the longest samples. If the samples of an epoch's last step cannot
    be divided evenly among the ranks, the index ~k of its shortest sample k is added, which
    `StudentDataset` returns unsupervised.

    Attributes:
        lengths: Length of each sample in tokens.
        batch: Samples per step, over all micro-batches and ranks.
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
            # The longest samples are first.
            step = step[np.argsort(-lengths[step], kind="stable")]
            yield from self._deal(step).tolist()

    def _deal(self, step: np.ndarray) -> np.ndarray:
        """Arrange the sorted samples of a step in the order in which the ranks get them."""
        fillers = np.repeat(~step[-1:], self._missing(len(step)))
        rounds = np.append(step, fillers)
        if self.world_size > 1:
            rounds = rounds.reshape(-1, self.world_size, self.micro_batch)
            rounds[1::2] = rounds[1::2, ::-1]
        return rounds.ravel()

    def _missing(self, samples: int) -> int:
        """Return the number of samples to add to a step so that all ranks get equally many."""
        each_round = self.micro_batch * self.world_size
        return -samples % each_round if self.world_size > 1 else 0
