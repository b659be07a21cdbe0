"""Training samples and their order.

Samples are rendered when they are read, so that few pixels are in memory at a time. The items of an
epoch are in random order, and the samples of a step are sorted by length.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch.utils.data import Dataset, Sampler
from transformers import ProcessorMixin

from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import Sample, build_sample

LABEL_TOKENS = 6
"""Number of text tokens before each image or pair of video frames."""


@dataclass(frozen=True)
class LazySample:
    """A sample before it is rendered.

    Attributes:
        text: Text of the prompt and the response, without parts that all prompts have.
        picture_count: Number of images plus number of frame pairs of the clip. With `text`, it
            determines the estimated length in tokens.
        item_id: Id of its selection item.
        render: Returns the sample in a given epoch; for distillation, `PairedPrompts`.
        family: Family of the selection item.
    """

    text: str
    picture_count: int
    item_id: str
    render: Callable[[int], Sample]
    family: str | None = None


@dataclass(eq=False)
class StudentDataset(Dataset):
    """Samples that are rendered when a trainer reads them.

    The index ~k, which is negative, returns sample k unsupervised. `LengthSampler` fills up the
    last step of an epoch with such indices.
    """

    samples: Sequence[LazySample]
    epoch: int = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        if index < 0:
            return replace(self[~index], supervised=False)
        return self.samples[index].render(self.epoch)

    @property
    def families(self) -> list[str | None]:
        return [s.family for s in self.samples]

    @property
    def item_ids(self) -> list[str]:
        return [s.item_id for s in self.samples]

    @property
    def texts(self) -> list[str]:
        return [s.text for s in self.samples]

    def lengths(self, processor: ProcessorMixin, image_size: int) -> list[int]:
        """Estimate each sample's number of tokens, with frames of `image_size` px, not rendered."""
        ids = processor.tokenizer(self.texts, add_special_tokens=False).input_ids
        per_picture = count_picture_tokens(processor, image_size)
        return [
            len(i) + s.picture_count * per_picture for i, s in zip(ids, self.samples, strict=True)
        ]


def count_picture_tokens(processor: ProcessorMixin, image_size: int) -> int:
    """Return the number of tokens of an image of `image_size` px in a prompt, with its label."""
    image = np.zeros((image_size, image_size, 3), np.uint8)
    prompts = [build_sample("", ["text", *images], None) for images in ([], [image])]
    without, with_image = (len(encode(p, processor, None).input_ids) for p in prompts)
    return with_image - without + LABEL_TOKENS


def seeded_rng(*keys: int | str) -> np.random.Generator:
    """Return a generator whose seed is a hash of `keys`."""
    digest = hashlib.sha256(repr(keys).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


@dataclass(eq=False)
class LengthSampler(Sampler[int]):
    """Yields the indices of all samples: those of an item together, and the items in random order.

    Within a step, the samples are sorted by length, so that the padding of micro-batches is small.
    Which samples a step has depends neither on this order nor on the number of ranks. An item with
    two samples has both in the same step if the batch is even.

    accelerate gives consecutive micro-batches to the ranks in turn. Every other round is reversed,
    so that no rank always gets the longest samples. If the samples of an epoch's last step cannot
    be divided evenly among the ranks, the index ~k of its last sample k is added, which
    `StudentDataset` returns unsupervised.

    Attributes:
        lengths: Length of each sample in tokens.
        item_ids: Item of each sample.
        batch: Samples per step, over all micro-batches and ranks.
        pairs: Whether an item's samples follow each other within a step, so that they are in one
            micro-batch of even size. `models.layers.shared_prompts` then computes their prompt
            once.
    """

    lengths: Sequence[int]
    item_ids: Sequence[str]
    batch: int
    seed: int
    micro_batch: int = 1
    world_size: int = 1
    pairs: bool = False
    epoch: int = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return len(self.lengths) + self._missing(len(self.lengths) % self.batch)

    def __iter__(self) -> Iterator[int]:
        order = self._shuffle()
        for start in range(0, len(order), self.batch):
            yield from self._deal(self._sort(order[start : start + self.batch])).tolist()

    def _shuffle(self) -> list[int]:
        """Return all samples, with the items in random order. Items with one sample are in twos, so
        that the ends of even steps separate no item with two samples."""
        samples_of = self._samples_of(range(len(self.lengths)))
        items = np.random.default_rng([self.seed, self.epoch]).permutation(list(samples_of))
        order, single = [], []
        for item in items:
            samples = samples_of[item]
            if len(samples) == 1 and not single:
                single = samples
            elif len(samples) == 1:
                order += single + samples
                single = []
            else:
                order += samples
        return order + single

    def _samples_of(self, samples: Iterable[int]) -> dict[str, list[int]]:
        """Return the samples of each item."""
        found: dict[str, list[int]] = {}
        for sample in samples:
            found.setdefault(self.item_ids[sample], []).append(sample)
        return found

    def _sort(self, step: list[int]) -> list[int]:
        """Sort the samples of a step from the longest to the shortest. With `pairs`, sort items by
        their longest sample; those with fewer samples are last and separate no others."""
        step = sorted(step, key=lambda k: -self.lengths[k])
        if not self.pairs:
            return step
        items = sorted(self._samples_of(step).values(), key=lambda samples: -len(samples))
        return [sample for samples in items for sample in samples]

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
