"""Samples that are rendered when they are read, so that few pixels are in memory at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch.utils.data import Dataset
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
