"""Auxiliary loss of the tiny base: the visual token at an object's place predicts its words.

The language loss alone trains vision slowly, because a model can lower it by learning phrases and
nearly ignore the images. This loss trains each visual token that shows an object to predict the
words that name the object: its color, material and shape. In a candidate, the token also predicts
the candidate's letter; in a clip, it also predicts the object's heading or "stationary".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.nn import Module
from torch.nn.functional import pad
from transformers import ProcessorMixin

from data.records import COLORS, MATERIALS, SHAPES
from models.student.collator import IGNORED, Collator
from models.student.prompts import Sample
from teacher.predicates.facts import COMPASS
from train.student.trainer import StudentTrainer

WEIGHT = 6.0
"""Weight of the loss at one visual token, relative to one supervised token of the response."""
PLACES = ("top", "left", "right", "center", "bottom")
"""Words that follow "near the" in the names of regions; "top-left" begins with "top"."""
MOTION = ("moves", "does")
"""First words of the phrases for motion ("moves slowly") and rest ("does not move")."""
MAX_WORDS = 4
"""Maximum number of words per visual token: color, material, shape, and a candidate's letter or the
motion in a clip."""
NO_WORD = -1
"""Padding for visual tokens with fewer words."""


def scene_word_tokens(processor: ProcessorMixin) -> dict[str, list[int]]:
    """Return ids of the first tokens of words for objects, places and motion, by kind of word."""
    kinds = {"color": COLORS, "material": MATERIALS, "shape": SHAPES, "place": PLACES}
    kinds |= {"motion": MOTION, "heading": COMPASS}
    return {kind: [first_token(processor, w) for w in words] for kind, words in kinds.items()}


def first_token(processor: ProcessorMixin, word: str) -> int:
    """Return the id of a word's first token within a sentence."""
    return processor.tokenizer.encode(f" {word}", add_special_tokens=False)[0]


class ObjectTokenCollator(Collator):
    """Makes batches with `object_labels` (N, 2 + MAX_WORDS), and with `labels` and `logits_to_keep`
    for all positions, so that the model returns logits at the visual tokens too.

    A row of `object_labels` has the batch row and the position of a visual token, and then the ids
    of the first tokens of its words, padded with NO_WORD.
    """

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        batch = super().__call__(samples)
        length = batch["input_ids"].shape[1]
        batch["labels"] = pad(
            batch["labels"], (length - batch["labels"].shape[1], 0), value=IGNORED
        )
        batch["logits_to_keep"] = torch.arange(length)
        rows = [
            row
            for k, sample in enumerate(samples)
            if sample.supervised
            for row in self._label_rows(sample, k, batch["input_ids"][k])
        ]
        batch["object_labels"] = torch.tensor(rows).reshape(-1, 2 + MAX_WORDS)
        return batch

    def _label_rows(self, sample: Sample, row: int, ids: torch.Tensor) -> Iterator[list[int]]:
        visual = torch.tensor([self._processor.image_token_id, self._processor.video_token_id])
        positions = torch.isin(ids, visual).nonzero()[:, 0].tolist()
        per_picture = len(positions) // max(1, sample.pictures)
        grid = math.isqrt(per_picture)
        for label in sample.object_labels:
            column, line = (min(int(share * grid), grid - 1) for share in label.place)
            position = positions[label.picture * per_picture + line * grid + column]
            words = [first_token(self._processor, word) for word in label.words]
            yield [row, position, *words, *[NO_WORD] * (MAX_WORDS - len(words))]


class ObjectTokenTrainer(StudentTrainer):
    """A trainer that adds the loss on object tokens to the training loss."""

    def compute_loss(
        self,
        model: Module,
        inputs: dict[str, Any],
        return_outputs: bool = False,
        num_items_in_batch: torch.Tensor | int | None = None,
    ) -> Any:
        object_labels = inputs.pop("object_labels")
        loss, outputs = super().compute_loss(
            model, inputs, True, num_items_in_batch=num_items_in_batch
        )
        if model.training and len(object_labels):
            # `num_items_in_batch` counts the tokens of all ranks, but gradients are averaged over
            # ranks. A factor of the number of ranks makes it a sum, as in the language loss.
            weight = self.accelerator.num_processes * WEIGHT
            object_loss = object_token_loss(outputs.logits, object_labels)
            loss = loss + weight * object_loss / num_items_in_batch
        return (loss, outputs) if return_outputs else loss


def object_token_loss(logits: torch.Tensor, object_labels: torch.Tensor) -> torch.Tensor:
    """Return the cross entropy between the logits at visual tokens and the words of their objects.

    The target distribution is uniform over the words of an object. The losses of all objects are
    summed.

    Args:
        logits: (B, L, V).
        object_labels: (N, 2 + MAX_WORDS), see `ObjectTokenCollator`.
    """
    row, position, words = object_labels[:, 0], object_labels[:, 1], object_labels[:, 2:]
    log_probabilities = logits[row, position].float().log_softmax(dim=-1)
    is_word = words != NO_WORD
    of_words = log_probabilities.gather(1, words.clamp(min=0)).masked_fill(~is_word, 0.0)
    return -(of_words.sum(dim=1) / is_word.sum(dim=1)).sum()
