"""What differs from transformers.Trainer for a student: the loss of an accumulated batch, the order
of samples and of their candidates in an epoch, and the measure of the answer's letter."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch.distributed.fsdp import register_fsdp_forward_method
from torch.nn import Module
from torch.nn.functional import cross_entropy
from torch.utils.data import DataLoader
from transformers import EvalPrediction, Trainer

from conf.errors import UserError
from conf.runs import rank, write_json
from models.student.collator import IGNORED
from train.student.held_out_answers import HeldOutAnswers
from train.student.lazy_samples import LengthSampler, Samples
from train.student.vision_cache import Features


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


def token_losses(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """(B, 2) each sample's cross entropy, summed over its supervised tokens, and their count."""
    following = labels[:, 1:]
    losses = cross_entropy(
        logits[:, :-1].transpose(1, 2).float(), following, ignore_index=IGNORED, reduction="none"
    )
    return torch.stack([losses.sum(dim=-1), (following != IGNORED).sum(dim=-1)], dim=-1)


STOPPED = "stopped.json"
"""Names the samples whose loss or gradient was no number; another rank than the main one has its
number in front."""


class StudentTrainer(Trainer):
    """A Trainer that takes its samples in an `order` of ours and makes training batches with a
    `training_collator`, measures an evaluation by a `choice` that is told the samples and by the
    `answers` that the student writes, if any are to be written, and stops where a loss or a
    gradient is no number.

    The loss of an evaluation is the mean over all supervised tokens of its samples; the trainer's
    own would hang on how they are split into micro-batches and ranks.
    """

    def __init__(
        self,
        *args: Any,
        training_collator: Callable[[list[Any]], dict[str, Any]],
        order: LengthSampler,
        choice: TokenChoice | LetterChoice,
        features: Features | None = None,
        answers: HeldOutAnswers | None = None,
        **settings: Any,
    ) -> None:
        """`features`: keeps the frozen tower's outputs; the collator is then `features.Keyed`."""
        super().__init__(
            *args,
            preprocess_logits_for_metrics=self._shrink,
            compute_metrics=self._measure,
            **settings,
        )
        self._order = order
        self._choice = choice
        self._training_collator = training_collator
        self._features = features
        self._answers = answers
        self._asked = False
        self._stepped: tuple[int, list[str]] = (-1, [])

    def get_train_dataloader(self) -> DataLoader:
        # An evaluation's samples are measured by their rows.
        others, self.data_collator = self.data_collator, self._training_collator
        loader = super().get_train_dataloader()
        self.data_collator = others
        return loader

    def _get_train_sampler(self, *_: Any) -> LengthSampler:
        return self._order

    def _shrink(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """(B, 2 + kept) the losses, and what the choice keeps."""
        return torch.cat(
            [token_losses(logits, labels), self._choice.shrink(logits, labels)], dim=-1
        )

    def _measure(self, prediction: EvalPrediction) -> dict[str, float]:
        losses, kept = np.split(prediction.predictions, [2], axis=-1)
        total, count = losses.sum(axis=0, dtype=np.float64)
        told = self._choice.measure(EvalPrediction(kept, prediction.label_ids), self._measured)
        # The trainer names this after its own mean, which it thereby takes the place of.
        return {**told, "loss": total / count}

    def evaluation_loop(
        self, dataloader: DataLoader, *args: Any, metric_key_prefix: str = "eval", **settings: Any
    ) -> Any:
        self._measured: Samples = dataloader.dataset
        settings["metric_key_prefix"] = metric_key_prefix
        found = super().evaluation_loop(dataloader, *args, **settings)
        if self._answers is not None:
            # All ranks ask alike: a sharded model needs every one of them, and its root's weights.
            if not self._asked:
                register_fsdp_forward_method(self.model, "generate")
                self._asked = True
            written = self._answers.measure(
                self.model,
                metric_key_prefix.removeprefix("eval_"),
                self._measured,
                self.state.global_step,
                keep=self.is_world_process_zero(),
            )
            found.metrics.update({f"{metric_key_prefix}_{k}": v for k, v in written.items()})
        return found

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
            self._stop("loss", loss.item(), ids)
        if model.training:
            step, before = self._stepped
            now = self.state.global_step
            self._stepped = (now, [*(before if step == now else []), *ids])
        return found

    def log(self, logs: dict[str, float], *args: Any, **settings: Any) -> None:
        """Raises UserError for a gradient that is no number, before weights of it are saved."""
        super().log(logs, *args, **settings)
        norm = logs.get("grad_norm")
        if norm is not None and not math.isfinite(norm):
            self._stop("gradient", norm, self._stepped[1])

    def _stop(self, what: str, found: float, ids: list[str]) -> NoReturn:
        name = f"{rank()}-{STOPPED}" if rank() else STOPPED
        step, path = self.state.global_step, Path(self.args.output_dir) / name
        write_json(path, {"step": step, what: str(found), "samples": ids})
        raise UserError(
            f"the {what} is {found} after step {step}; {path} names the samples. A lower train.lr "
            "or train.precision=fp32 may help, in a run of its own (run=NAME); what was trained up "
            "to the last checkpoint is kept"
        )


class TokenChoice:
    """The share of supervised tokens that a model would write, all before each being given: of all
    tokens, and of the `words` of each kind, which tell what is seen where the rest is grammar."""

    def __init__(self, words: dict[str, list[int]]) -> None:
        self._words = {kind: torch.tensor(ids) for kind, ids in words.items()}

    def shrink(self, logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """(B, 2 * (1 + kinds)) counts of the tokens that are right and of all, kind by kind."""
        chosen, following = logits[:, :-1].argmax(dim=-1), labels[:, 1:]
        right = chosen == following
        counted = [following != IGNORED]
        counted += [torch.isin(following, ids.to(labels.device)) for ids in self._words.values()]
        counts = [torch.stack([(right & c).sum(dim=-1), c.sum(dim=-1)], dim=-1) for c in counted]
        return torch.cat(counts, dim=1)

    def measure(self, prediction: EvalPrediction, samples: Samples) -> dict[str, float]:
        counts = prediction.predictions.sum(axis=0).reshape(-1, 2)
        return {
            f"{kind}_accuracy": float(right / counted)
            for kind, (right, counted) in zip(("token", *self._words), counts, strict=True)
            if counted
        }


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
