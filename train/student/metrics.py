"""Accuracies on validation samples, measured from a few numbers per sample instead of logits."""

from __future__ import annotations

import numpy as np
import torch
from transformers import EvalPrediction

from dynapix.models.student.collator import IGNORED
from dynapix.train.student.lazy_samples import StudentDataset


class LetterAccuracy:
    """Share of samples whose correct letter has the highest logit of all letters.

    The model reads the correct response up to the letter. In reasoning mode, this includes the
    teacher's rationale, so the accuracy measures whether the student draws the conclusion from it.

    Args:
        letters: Token ids of the letters, from `letter_ids`.
    """

    def __init__(self, letters: list[int]) -> None:
        self._letters = torch.tensor(letters)

    def reduce(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return (B, 2): the index of the chosen letter and that of the correct letter.

        The letter is the second-to-last supervised token; the last ends the turn.
        """
        letters = self._letters.to(logits.device)
        positions = torch.arange(labels.shape[1], device=labels.device)
        # With several ranks, the trainer pads batches on the right, to the width of the widest.
        letter = torch.where(labels != IGNORED, positions, 0).amax(dim=1) - 1
        rows = torch.arange(len(labels), device=labels.device)
        chosen = logits[rows, letter - 1][:, letters].argmax(dim=-1)
        right = (labels[rows, letter, None] == letters).int().argmax(dim=-1)
        return torch.stack([chosen, right], dim=-1)

    @staticmethod
    def measure(prediction: EvalPrediction, samples: StudentDataset) -> dict[str, float]:
        """Return the accuracy over all samples and by family."""
        right = prediction.predictions[:, 0] == prediction.predictions[:, 1]
        families = np.asarray(samples.families)
        by_family = {
            f"letter_accuracy_{family}": float(right[families == family].mean())
            for family in sorted(set(samples.families))
        }
        return {"letter_accuracy": float(right.mean()), **by_family}
