"""Samples that are made when they are asked for, and the order they come in."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch.utils.data import Dataset, Sampler
from transformers import PreTrainedTokenizerBase

from models.student.prompts import Sample

TOKEN, STAMP = 32, 8
"""Side in px of the square that a token shows, and tokens about each piece of media."""


@dataclass(frozen=True)
class LazySample:
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
    """Planned samples as a trainer reads them, as they are in an epoch. At ~index, below 0, is the
    sample of that index with nothing supervised."""

    def __init__(self, planned: Sequence[LazySample]) -> None:
        self._planned = planned
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self._planned)

    def __getitem__(self, index: int) -> Sample:
        if index < 0:
            return replace(self[~index], supervised=False)
        return self._planned[index].make(self._epoch)

    @property
    def texts(self) -> list[str]:
        return [p.text for p in self._planned]

    @property
    def families(self) -> list[str | None]:
        return [p.family for p in self._planned]

    def lengths(self, tokenizer: PreTrainedTokenizerBase, image_size: int) -> list[int]:
        """About how many tokens each sample has, without making it."""
        texts = [p.text for p in self._planned]
        ids = tokenizer(texts, add_special_tokens=False).input_ids
        each = round(image_size / TOKEN) ** 2 + STAMP
        return [len(i) + p.media * each for i, p in zip(ids, self._planned, strict=True)]


class LengthSampler(Sampler[int]):
    """All samples in a random order of each epoch, those of a step sorted by length, so that little
    of a micro-batch is padding. What a step holds does not hang on how it is split.

    Ranks take a micro-batch each in turn. Neighbours in length pass at once, and now the one rank
    gets the longer, now the other. Where the last step of an epoch is too small for all, it is
    filled up with samples of which nothing is supervised.
    """

    def __init__(
        self, lengths: Sequence[int], batch: int, seed: int, micro_batch: int = 1, ranks: int = 1
    ) -> None:
        """`batch`: samples of a step, over all its micro-batches and ranks."""
        self._lengths = np.asarray(lengths)
        self._batch = batch
        self._seed = seed
        self._micro_batch = micro_batch
        self._ranks = ranks
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self._lengths) + self._missing(len(self._lengths) % self._batch)

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng([self._seed, self._epoch])
        order = rng.permutation(len(self._lengths))
        for start in range(0, len(order), self._batch):
            step = order[start : start + self._batch]
            # The longest come first, so that what memory they take is known at the start.
            yield from self._dealt(step[np.argsort(-self._lengths[step], kind="stable")]).tolist()

    def _dealt(self, step: np.ndarray) -> np.ndarray:
        """A step's samples, longest first, in the order in which the ranks take them."""
        fillers = np.repeat(~step[-1:], self._missing(len(step)))
        rounds = np.append(step, fillers)
        if self._ranks > 1:
            rounds = rounds.reshape(-1, self._ranks, self._micro_batch)
            rounds[1::2] = rounds[1::2, ::-1]
        return rounds.ravel()

    def _missing(self, samples: int) -> int:
        """How many samples a step of so many lacks for all ranks to have as much to do."""
        return -samples % (self._micro_batch * self._ranks) if self._ranks > 1 else 0


def seeded_rng(*keys: int | str) -> np.random.Generator:
    """A generator that follows from `keys` alone."""
    digest = hashlib.sha256(repr(keys).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))
