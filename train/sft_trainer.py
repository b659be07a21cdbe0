"""What differs from transformers.Trainer for a student: the loss of an accumulated batch, the order
of samples and of their candidates in an epoch, and the measure of the answer's letter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import Module
from torch.nn.functional import cross_entropy
from torch.utils.data import DataLoader
from transformers import EvalPrediction, Trainer, TrainerCallback
from transformers.trainer_callback import TrainerControl, TrainerState

from conf.errors import UserError
from conf.runs import write_json
from train.collate import IGNORED
from train.features import Features
from train.planned import ByLength, Samples


def token_mean(
    outputs: Any, labels: torch.Tensor, num_items_in_batch: torch.Tensor | int | None = None
) -> torch.Tensor:
    """Cross entropy summed over a micro-batch's supervised tokens, over the count of those in the
    whole accumulated batch, so that every token weighs the same whatever sample it is of.

    Transformers averages this model's samples first, so that an answer of three tokens would weigh
    as much as a whole rationale.
    """
    predicted, following = outputs.logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten()
    total = cross_entropy(predicted.float(), following, ignore_index=IGNORED, reduction="sum")
    count = num_items_in_batch if num_items_in_batch is not None else (following != IGNORED).sum()
    return total / count


STOPPED = "stopped.json"
"""Names the samples whose loss was no number."""


class StudentTrainer(Trainer):
    """A Trainer that takes its samples in an `order` of ours, measures an evaluation by a `choice`
    that is told the samples, and stops where a loss is no number."""

    def __init__(
        self,
        *args: Any,
        order: ByLength,
        choice: TokenChoice | LetterChoice,
        features: Features | None = None,
        **settings: Any,
    ) -> None:
        """`features`: keeps the frozen tower's outputs; the collator is then `features.Keyed`."""
        super().__init__(
            *args,
            preprocess_logits_for_metrics=choice.shrink,
            compute_metrics=lambda prediction: choice.measure(prediction, self._measured),
            **settings,
        )
        self._order = order
        self._features = features

    def _get_train_sampler(self, *_: Any) -> ByLength:
        return self._order

    def evaluation_loop(self, dataloader: DataLoader, *args: Any, **settings: Any) -> Any:
        self._measured: Samples = dataloader.dataset
        return super().evaluation_loop(dataloader, *args, **settings)

    def compute_loss(
        self, model: Module, inputs: dict[str, Any], return_outputs: bool = False, **settings: Any
    ) -> Any:
        """Raises UserError for a loss that is no number; the samples' ids are then in a file."""
        ids = inputs.pop("sample_ids")
        if self._features is not None:
            self._features.give(inputs)
        found = super().compute_loss(model, inputs, return_outputs, **settings)
        loss = found[0] if return_outputs else found
        if not torch.isfinite(loss):
            step, path = self.state.global_step, Path(self.args.output_dir) / STOPPED
            write_json(path, {"step": step, "loss": str(loss.item()), "samples": ids})
            raise UserError(
                f"the loss is {loss.item()} after step {step}; {path} names the samples. A lower "
                "train.lr or train.precision=fp32 may help; what was trained up to the last "
                "checkpoint is kept"
            )
        return found


class Epochs(TrainerCallback):
    """Tells the training samples and their order which epoch it is."""

    def __init__(self, training: Samples, order: ByLength) -> None:
        self._training, self._order = training, order

    def on_epoch_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        # A resumed run goes on within an epoch.
        epoch = int(state.epoch or 0)
        self._training.epoch = epoch
        self._order.set_epoch(epoch)


class TokenChoice:
    """The share of supervised tokens that a model would write, all before each being given."""

    @staticmethod
    def shrink(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """(B, 2) counts of the tokens that are right and of all."""
        chosen, following = logits[:, :-1].argmax(dim=-1), labels[:, 1:]
        right = (chosen == following).sum(dim=-1)
        return torch.stack([right, (following != IGNORED).sum(dim=-1)], dim=-1)

    @staticmethod
    def measure(prediction: EvalPrediction, samples: Samples) -> dict[str, float]:
        right, counted = prediction.predictions.sum(axis=0)
        return {"token_accuracy": float(right / counted)}


class LetterChoice:
    """The letter that a student would answer, from the letters' logits where the answer's letter
    stands; two numbers an item are kept, never the logits.

    Everything before the letter is given. In reasoning mode that is the teacher's own rationale,
    so the measure there is whether the student's answer follows from what was reasoned.
    """

    def __init__(self, letters: list[int]) -> None:
        self._letters = torch.tensor(letters)

    def shrink(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """(B, 2) index of the chosen letter and of the right one.

        The letter is the last supervised token but one, before the end of the turn.
        """
        letters = self._letters.to(logits.device)
        places = torch.arange(labels.shape[1], device=labels.device)
        # Several ranks pad their batches on the right to one width.
        letter = torch.where(labels != IGNORED, places, 0).amax(dim=1) - 1
        rows = torch.arange(len(labels), device=labels.device)
        chosen = logits[rows, letter - 1][:, letters].argmax(dim=-1)
        right = (labels[rows, letter, None] == letters).int().argmax(dim=-1)
        return torch.stack([chosen, right], dim=-1)

    @staticmethod
    def measure(prediction: EvalPrediction, samples: Samples) -> dict[str, float]:
        """The share of right letters, and that of each family's samples."""
        right = prediction.predictions[:, 0] == prediction.predictions[:, 1]
        families = np.asarray(samples.families)
        by_family = {
            f"letter_accuracy_{family}": float(right[families == family].mean())
            for family in sorted(set(samples.families))
        }
        return {"letter_accuracy": float(right.mean()), **by_family}
