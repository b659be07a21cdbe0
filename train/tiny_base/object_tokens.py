"""Auxiliary loss on visual tokens: each token at an object's place predicts the object's words.

The answers of the questions are a weak signal of what is visible: a model can learn to phrase them
well with hardly a look at the pictures. The words of the object at each visual token are a strong
signal. In candidates, a token also predicts the candidate's letter; in clips, the object's heading.
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
"""Weight of an object at a visual token, in supervised tokens of the response."""
PLACES = ("top", "left", "right", "center", "bottom")
"""Words with which regions begin, after "near the"."""
MOTION = ("moves", "does")
"""Words with which motion and rest begin ("moves slowly", "does not move")."""
WORDS = 4
"""Most words per visual token: color, material, shape, and a candidate's letter or a heading."""
NONE = -1
"""Padding for tokens with fewer words."""


def scene_word_tokens(processor: ProcessorMixin) -> dict[str, list[int]]:
    """The first token of each word for objects, places and motion, by kind of word."""
    kinds = {"color": COLORS, "material": MATERIALS, "shape": SHAPES, "place": PLACES}
    kinds |= {"motion": MOTION, "heading": COMPASS}
    return {kind: [first_token(processor, w) for w in words] for kind, words in kinds.items()}


def first_token(processor: ProcessorMixin, word: str) -> int:
    return processor.tokenizer.encode(f" {word}", add_special_tokens=False)[0]


class ObjectTokenCollator(Collator):
    """Adds `sights` (N, 2 + WORDS) to batches, and keeps the logits of all positions.

    A row of `sights` has the row and position of a visual token, and the first tokens of its
    words, padded with NONE.
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
                for row in self._encode_sights(s, k, batch["input_ids"][k])
            ]
        ).reshape(-1, 2 + WORDS)
        return batch

    def _encode_sights(self, sample: Sample, row: int, ids: torch.Tensor) -> list[list[int]]:
        visual = torch.tensor([self._processor.image_token_id, self._processor.video_token_id])
        positions = torch.isin(ids, visual).nonzero()[:, 0].tolist()
        each = len(positions) // max(1, sample.pictures)
        grid = math.isqrt(each)
        rows = []
        for sight in sample.sights:
            column, line = (min(int(share * grid), grid - 1) for share in sight.place)
            position = positions[sight.picture * each + line * grid + column]
            words = [first_token(self._processor, word) for word in sight.words]
            rows.append([row, position, *words, *[NONE] * (WORDS - len(words))])
        return rows


class ObjectTokenTrainer(StudentTrainer):
    """A trainer that adds the object token loss to the training loss."""

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
            # Gradients are averaged over ranks; this factor undoes that, as in the language loss.
            world_size = self.accelerator.num_processes
            loss = (
                loss
                + world_size
                * WEIGHT
                * object_token_loss(outputs.logits, sights)
                / num_items_in_batch
            )
        return (loss, outputs) if return_outputs else loss


def object_token_loss(logits: torch.Tensor, sights: torch.Tensor) -> torch.Tensor:
    """Cross entropy of visual tokens with the words of their objects, summed over `sights`.

    The words of an object are equally likely targets.

    Args:
        logits: (B, L, V).
        sights: (N, 2 + WORDS), see `ObjectTokenCollator`.
    """
    row, position, words = sights[:, 0], sights[:, 1], sights[:, 2:]
    log_probabilities = logits[row, position].float().log_softmax(dim=-1)
    is_word = words != NONE
    each = log_probabilities.gather(1, words.clamp(min=0)).masked_fill(~is_word, 0.0)
    return -(each.sum(dim=1) / is_word.sum(dim=1)).sum()
