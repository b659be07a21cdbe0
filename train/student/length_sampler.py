"""The order of training samples: items at random in an epoch, sorted by length within a step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch.utils.data import Sampler


@dataclass(eq=False)
class LengthSampler(Sampler[int]):
    """Yields the indices of all samples: those of an item together, and the items in random order.

    `models.shared_prompts` computes the start of an item's prompts once if its samples are in the
    same micro-batch. Within a step, the items with the longest samples are first, so that the
    padding of micro-batches is small. Which samples a step has depends neither on the size of the
    micro-batches nor on the number of ranks.

    accelerate gives consecutive micro-batches to the ranks in turn. Every other round is reversed,
    so that no rank always gets the longest samples. If the samples of an epoch's last step cannot
    be divided evenly among the ranks, the index ~k of its last sample k is added, which
    `StudentDataset` returns unsupervised.

    Attributes:
        lengths: Length of each sample in tokens.
        item_ids: Item of each sample.
        batch: Samples per step, over all micro-batches and ranks.
    """

    lengths: Sequence[int]
    item_ids: Sequence[str]
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
        samples_of: dict[str, list[int]] = {}
        for sample, item in enumerate(self.item_ids):
            samples_of.setdefault(item, []).append(sample)
        items = np.random.default_rng([self.seed, self.epoch]).permutation(list(samples_of))
        order = [sample for item in items for sample in samples_of[item]]
        for start in range(0, len(order), self.batch):
            yield from self._deal(self._sort(order[start : start + self.batch])).tolist()

    def _sort(self, step: list[int]) -> list[int]:
        """Sort the samples of a step by the length of the longest sample of their item."""
        longest: dict[str, int] = {}
        for sample in step:
            item = self.item_ids[sample]
            longest[item] = max(longest.get(item, 0), self.lengths[sample])

        def sort_key(sample: int) -> tuple[int, str, int]:
            item = self.item_ids[sample]
            return -longest[item], item, -self.lengths[sample]

        return sorted(step, key=sort_key)

    def _deal(self, step: list[int]) -> np.ndarray:
        """Arrange the sorted samples of a step in the order in which the ranks get them."""
        rounds = np.array(step + [~step[-1]] * self._missing(len(step)))
        if self.world_size > 1:
            rounds = rounds.reshape(-1, self.world_size, self.micro_batch)
            rounds[1::2] = rounds[1::2, ::-1]
        return rounds.ravel()

    def _missing(self, samples: int) -> int:
        """Return the number of samples to add to a step so that all ranks get equally many."""
        each_round = self.micro_batch * self.world_size
        return -samples % each_round if self.world_size > 1 else 0
