"""Measures of held-out samples, reduced to a few numbers a sample before the logits are dropped."""

from __future__ import annotations

import numpy as np
import torch
from transformers import EvalPrediction

from models.student.collator import IGNORED
from train.student.lazy_samples import StudentDataset


class TokenAccuracy:
    """Share of supervised tokens that are the most likely ones, given all tokens before.

    Args:
        words: Token ids by kind of word. Each kind is also measured alone: the words for what is
            visible count little among all tokens, most of which are grammar.
    """

    def __init__(self, words: dict[str, list[int]]) -> None:
        self._words = {kind: torch.tensor(ids) for kind, ids in words.items()}

    def reduce(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return (B, 2 * (1 + kinds)): right tokens and their number, kind by kind."""
        chosen, following = logits[:, :-1].argmax(dim=-1), labels[:, 1:]
        right = chosen == following
        counted = [following != IGNORED]
        counted += [torch.isin(following, ids.to(labels.device)) for ids in self._words.values()]
        counts = [torch.stack([(right & c).sum(dim=-1), c.sum(dim=-1)], dim=-1) for c in counted]
        return torch.cat(counts, dim=1)

    def measure(self, prediction: EvalPrediction, samples: StudentDataset) -> dict[str, float]:
        counts = prediction.predictions.sum(axis=0).reshape(-1, 2)
        return {
            f"{kind}_accuracy": float(right / counted)
            for kind, (right, counted) in zip(("token", *self._words), counts, strict=True)
            if counted
        }


class LetterAccuracy:
    """Share of samples whose answer letter has the highest logit among the letters.

    The text before the letter is the held-out response. In reasoning mode that is the teacher's
    rationale: the measure is then whether the student's answer follows from it.

    Args:
        letters: Token ids of the letters, from `letter_ids`.
    """

    def __init__(self, letters: list[int]) -> None:
        self._letters = torch.tensor(letters)

    def reduce(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return (B, 2): index of the chosen letter and of the right one.

        The letter is the last supervised token but one, before the end of the turn.
        """
        letters = self._letters.to(logits.device)
        positions = torch.arange(labels.shape[1], device=labels.device)
        # Several ranks pad their batches on the right to one width.
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
