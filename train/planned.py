"""Samples that are made when they are asked for, and the order they come in."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from torch.utils.data import Dataset, Sampler
from transformers import PreTrainedTokenizerBase

from train.conversation import Sample

TOKEN, STAMP = 32, 8
"""Side in px of the square that a token shows, and tokens about each piece of media."""
BLOCK = 32
"""Micro-batches of samples that are sorted by length together."""


@dataclass(frozen=True)
class Planned:
    """A sample to be made when it is asked for, so that pixels are not held for all of them. It may
    differ by epoch.

    `text` is what it does not share with others of its kind, `media` counts the images and the
    pairs of a clip's frames that it shows: both tell how long it is. `family` is the item's, None
    where it is none.
    """

    text: str
    media: int
    make: Callable[[int], Sample]
    family: str | None = None


class Samples(Dataset):
    """Planned samples as a trainer reads them, as they are in `epoch`."""

    def __init__(self, planned: Sequence[Planned]) -> None:
        self._planned = planned
        self.epoch = 0

    def __len__(self) -> int:
        return len(self._planned)

    def __getitem__(self, index: int) -> Sample:
        return self._planned[index].make(self.epoch)

    @property
    def families(self) -> list[str | None]:
        return [p.family for p in self._planned]

    def lengths(self, tokenizer: PreTrainedTokenizerBase, image_size: int) -> list[int]:
        """About how many tokens each sample has, without making it."""
        texts = [p.text for p in self._planned]
        ids = tokenizer(texts, add_special_tokens=False).input_ids
        each = (image_size // TOKEN) ** 2 + STAMP
        return [len(i) + p.media * each for i, p in zip(ids, self._planned, strict=True)]


class ByLength(Sampler[int]):
    """All samples in a random order of each epoch, those of a micro-batch of about one length, so
    that little of it is padding."""

    def __init__(self, lengths: Sequence[int], micro_batch: int, seed: int) -> None:
        self._lengths = np.asarray(lengths)
        self._micro_batch = micro_batch
        self._seed = seed
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self._lengths)

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng([self._seed, self._epoch])
        order = rng.permutation(len(self._lengths))
        block = BLOCK * self._micro_batch
        batches: list[np.ndarray] = []
        for start in range(0, len(order), block):
            part = order[start : start + block]
            part = part[np.argsort(self._lengths[part], kind="stable")]
            batches += np.split(part, range(self._micro_batch, len(part), self._micro_batch))
        # A short one anywhere but at the end would shift all that follow it.
        whole = [b for b in batches if len(b) == self._micro_batch]
        rest = [b for b in batches if len(b) < self._micro_batch]
        for k in rng.permutation(len(whole)):
            yield from whole[k].tolist()
        for part in rest:
            yield from part.tolist()


def rng_of(*keys: int | str) -> np.random.Generator:
    """A generator that follows from `keys` alone."""
    digest = hashlib.sha256(repr(keys).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))
