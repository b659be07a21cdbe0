"""The parts of a student's training that depend on the regime."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn
from transformers import ProcessorMixin

from models.student.collator import Collator, letter_ids
from models.student.prompts import Sample
from train.student.metrics import LetterAccuracy, TokenAccuracy
from train.student.packing import PackingCollator, packing_rope
from train.student.trainer import StudentTrainer
from train.student.vision_cache import SLICES, slice_digests
from train.tiny_base.object_tokens import ObjectTokenCollator, ObjectTokenTrainer, scene_word_tokens


@dataclass(frozen=True)
class RegimeComponents:
    """What makes batches, what measures an evaluation, and what trains."""

    collator: Collator
    training_collator: Collator
    accuracy: TokenAccuracy | LetterAccuracy
    trainer: Callable[..., StudentTrainer]


def regime_components(
    regime: str, model: nn.Module, processor: ProcessorMixin, max_length: int, packing: str
) -> RegimeComponents:
    if regime == "describe":
        # Descriptions have no answer letter to measure.
        collator = ObjectTokenCollator(processor, max_length)
        accuracy = TokenAccuracy(scene_word_tokens(processor))
        return RegimeComponents(collator, collator, accuracy, ObjectTokenTrainer)
    padding = Collator(processor, max_length)
    rope = packing_rope(model, packing)
    training = PackingCollator(processor, max_length, rope) if rope else padding
    return RegimeComponents(
        padding, training, LetterAccuracy(letter_ids(processor)), StudentTrainer
    )


@dataclass(frozen=True)
class TrainerCollator:
    """Adds to a batch what `StudentTrainer` uses beside the tensors: the samples' ids and, for a
    `VisionCache`, the digests of the slices."""

    collator: Collator
    digests: bool

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        batch = {**self.collator(samples), "sample_ids": [s.sample_id for s in samples]}
        return {**batch, SLICES: slice_digests(samples)} if self.digests else batch
