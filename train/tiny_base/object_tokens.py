"""Teach a base to see, token by token: at the place of a visual token that shows an object, the
model names the object and, in a candidate, the candidate's letter; in a clip, the way it moves.

What a sample's answer says of its pictures is a weak sign of what they show: a model that writes it
well may hardly look. The words of the object at each visual token are a strong one, beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch.nn import Module
from torch.nn.functional import pad
from transformers import ProcessorMixin

from data.records import COLORS, MATERIALS, SHAPES
from models.student.collator import IGNORED, Collator
from models.student.prompts import Sample
from teacher.predicates import COMPASS
from train.student.trainer import StudentTrainer

WEIGHT = 6.0
"""A named object weighs as much as this many supervised tokens."""
PLACES = ("top", "left", "right", "center", "bottom")
"""First words of the places that an object is near."""
MOTION = ("moves", "does")
"""What tells that an object moves from that it does not."""
WORDS = 4
"""Words at most that a visual token is told: an object's colour, material and shape, and a
candidate's letter or, in a clip, the way that the object moves."""
NONE = -1
"""Stands where a token is told fewer words."""


def scene_word_tokens(processor: ProcessorMixin) -> dict[str, list[int]]:
    """The words of objects, of their places and of their motion, by kind, each by its first
    token."""
    kinds = {"color": COLORS, "material": MATERIALS, "shape": SHAPES, "place": PLACES}
    kinds |= {"motion": MOTION, "heading": COMPASS}
    return {kind: [first_token(processor, w) for w in words] for kind, words in kinds.items()}


def first_token(processor: ProcessorMixin, word: str) -> int:
    return processor.tokenizer.encode(f" {word}", add_special_tokens=False)[0]


class ObjectTokenCollator(Collator):
    """Batches that also hold `sights` (N, 2 + WORDS): row and position of a visual token, and the
    first tokens of the words that it is told, filled up with NONE. All positions keep their logits.
    """

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        batch = super().__call__(samples)
        length = batch["input_ids"].shape[1]
        batch["labels"] = pad(
            batch["labels"], (length - batch["labels"].shape[1], 0), value=IGNORED
        )
        batch["logits_to_keep"] = torch.arange(length)
        batch["sights"] = torch.tensor(
            [
                row
                for k, s in enumerate(samples)
                if s.supervised
                for row in self._of(s, k, batch["input_ids"][k])
            ]
        ).reshape(-1, 2 + WORDS)
        return batch

    def _of(self, sample: Sample, row: int, ids: torch.Tensor) -> list[list[int]]:
        visual = torch.tensor([self._processor.image_token_id, self._processor.video_token_id])
        positions = torch.isin(ids, visual).nonzero()[:, 0].tolist()
        each = len(positions) // max(1, sample.pictures)
        grid = math.isqrt(each)
        found = []
        for sight in sample.sights:
            column, line = (min(int(share * grid), grid - 1) for share in sight.place)
            position = positions[sight.picture * each + line * grid + column]
            words = [first_token(self._processor, word) for word in sight.words]
            found.append([row, position, *words, *[NONE] * (WORDS - len(words))])
        return found


class ObjectTokenTrainer(StudentTrainer):
    """A trainer whose loss also counts how well visual tokens name what they show."""

    def compute_loss(
        self,
        model: Module,
        inputs: dict[str, Any],
        return_outputs: bool = False,
        num_items_in_batch: torch.Tensor | int | None = None,
    ) -> Any:
        sights = inputs.pop("sights")
        loss, outputs = super().compute_loss(
            model, inputs, True, num_items_in_batch=num_items_in_batch
        )
        if model.training and len(sights):
            # The mean over ranks, by which gradients are shared, is undone as in the tokens' loss.
            ranks = self.accelerator.num_processes
            loss = (
                loss
                + ranks * WEIGHT * object_token_loss(outputs.logits, sights) / num_items_in_batch
            )
        return (loss, outputs) if return_outputs else loss


def object_token_loss(logits: torch.Tensor, sights: torch.Tensor) -> torch.Tensor:
    """Cross entropy between what visual tokens say and the words for what they show, each word as
    likely as the other; a sum over sights.

    Args:
        logits: (B, L, V).
        sights: (N, 2 + WORDS) as `SightCollator` gives them.
    """
    row, position, words = sights[:, 0], sights[:, 1], sights[:, 2:]
    told = logits[row, position].float().log_softmax(dim=-1)
    given = words != NONE
    each = told.gather(1, words.clamp(min=0)).masked_fill(~given, 0.0)
    return -(each.sum(dim=1) / given.sum(dim=1)).sum()
