"""The student's trainer, a transformers.Trainer with its own loss, order of samples and measures.

The loss weights all supervised tokens of an accumulated batch equally, or all its samples. A
non-finite loss or gradient stops the run before the affected weights are saved.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import nn
from torch.distributed.fsdp import register_fsdp_forward_method
from torch.nn.functional import cross_entropy
from torch.utils.data import DataLoader, Sampler
from transformers import EvalPrediction, ProcessorMixin, Trainer, TrainingArguments

from dynapix.conf.errors import UserError
from dynapix.conf.files import write_json
from dynapix.conf.runs import Run, local_world_size, rank, world_size
from dynapix.conf.schema import SftCommand, StudentTrainConfig
from dynapix.models.distributed import split_batch
from dynapix.models.layers.shared_prompts import shares_prompts
from dynapix.models.memory import available_cpu_bytes
from dynapix.models.student.chat_format import takes_clips
from dynapix.models.student.collator import IGNORED, Collator, letter_ids
from dynapix.models.student.prompts import Sample
from dynapix.train.common.audit import audit_student
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.common.training_loop import common_arguments
from dynapix.train.student.held_out_answers import HeldOutAnswers
from dynapix.train.student.samples import LengthSampler, StudentDataset
from dynapix.train.student.vision_cache import PAIRS, VisionCache, pair_digests

log = logging.getLogger(__name__)

STOPPED = "stopped.json"
"""File with the samples of a non-finite loss or gradient; ranks above 0 prefix their number."""


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


def token_mean(
    outputs: Any, labels: torch.Tensor, num_items_in_batch: torch.Tensor | int | None = None
) -> torch.Tensor:
    """Return a micro-batch's part of the mean cross entropy over an accumulated batch's tokens.

    This is the sum over the supervised tokens of the micro-batch, divided by `num_items_in_batch`,
    the number of supervised tokens of the accumulated batch (default: of the micro-batch). For
    Qwen3-VL, transformers would average each micro-batch first: an answer of three tokens could
    then weigh as much as a rationale.
    """
    predicted, following = outputs.logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten()
    total = cross_entropy(predicted.float(), following, ignore_index=IGNORED, reduction="sum")
    count = num_items_in_batch if num_items_in_batch is not None else (following != IGNORED).sum()
    return total / count


def token_losses(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Return (B, 2): for each sample, the sum of the cross entropy over its supervised tokens, and
    the number of these tokens."""
    following = labels[:, 1:]
    losses = cross_entropy(
        logits[:, :-1].transpose(1, 2).float(), following, ignore_index=IGNORED, reduction="none"
    )
    return torch.stack([losses.sum(dim=-1), (following != IGNORED).sum(dim=-1)], dim=-1)


def sample_mean(
    outputs: Any, labels: torch.Tensor, num_items_in_batch: torch.Tensor | int | None = None
) -> torch.Tensor:
    """Return a micro-batch's part of the mean over an accumulated batch's samples of their mean
    cross entropy.

    `num_items_in_batch` is the number of supervised samples of the accumulated batch (default: of
    the micro-batch).
    """
    losses, counts = token_losses(outputs.logits, labels).unbind(dim=-1)
    total = (losses / counts.clamp(min=1)).sum()
    return total / ((counts > 0).sum() if num_items_in_batch is None else num_items_in_batch)


LOSSES = {"token": token_mean, "sample": sample_mean}
"""The losses by `train.weighting`."""


@dataclass(frozen=True)
class TrainerCollator:
    """Adds the samples' ids to a batch and, if `digests` is set for a `VisionCache`, the digests of
    its frame pairs."""

    collator: Collator
    digests: bool

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        batch = {**self.collator(samples), "sample_ids": [s.sample_id for s in samples]}
        return {**batch, PAIRS: pair_digests(samples)} if self.digests else batch


class StudentTrainer(Trainer):
    """A Trainer with its own order of samples, loss and measures.

    The loss of an evaluation is the mean over all supervised tokens of its samples. It depends
    neither on the batch size nor on the number of ranks.

    Args:
        sampler: The order of the training samples.
        accuracy: Computes the accuracies of an evaluation.
        answers: Generates answers to validation samples at each evaluation, or None.
        vision_cache: Keeps the frozen vision tower's outputs, or None.
    """

    def __init__(
        self,
        *args: Any,
        sampler: Sampler[int],
        accuracy: LetterAccuracy,
        answers: HeldOutAnswers | None = None,
        vision_cache: VisionCache | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(
            *args,
            preprocess_logits_for_metrics=self._reduce,
            compute_metrics=self._measure,
            **settings,
        )
        self._sampler = sampler
        self._accuracy = accuracy
        self._answers = answers
        self._vision_cache = vision_cache
        self._step_samples: list[str] = []

    def _get_train_sampler(self, *_: Any) -> Sampler[int]:
        return self._sampler

    def _get_num_items_in_batch(self, batches: list, device: torch.device) -> Any:
        """Return the number of supervised tokens of an accumulated batch on all ranks, or of
        supervised samples for `sample_mean`."""
        if self.compute_loss_func is sample_mean:
            # The largest label of a sample stands for all: it is IGNORED if none is supervised.
            batches = [{**b, "shift_labels": b["labels"].amax(dim=1)} for b in batches]
        return super()._get_num_items_in_batch(batches, device)

    def _reduce(
        self, outputs: torch.Tensor | tuple[torch.Tensor, ...], labels: torch.Tensor
    ) -> torch.Tensor:
        """Return (B, 2 + columns of the accuracy), which the evaluation keeps instead of logits."""
        # Some families also return the hidden states of images.
        logits = outputs[0] if isinstance(outputs, tuple) else outputs
        reduced = self._accuracy.reduce(logits, labels)
        return torch.cat([token_losses(logits, labels), reduced], dim=-1)

    def _measure(self, prediction: EvalPrediction) -> dict[str, float]:
        losses, reduced = np.split(prediction.predictions, [2], axis=-1)
        total, count = losses.sum(axis=0, dtype=np.float64)
        kept = EvalPrediction(reduced, prediction.label_ids)
        # "loss" replaces the library's loss, which is a mean over batches instead of tokens.
        return {**self._accuracy.measure(kept, self._evaluated), "loss": total / count}

    def evaluation_loop(
        self, dataloader: DataLoader, *args: Any, metric_key_prefix: str = "eval", **settings: Any
    ) -> Any:
        self._evaluated = dataloader.dataset
        settings["metric_key_prefix"] = metric_key_prefix
        output = super().evaluation_loop(dataloader, *args, **settings)
        if self._answers is not None:
            # All ranks generate, because each rank has only a part of a sharded model.
            if "generate" not in vars(self.model):
                register_fsdp_forward_method(self.model, "generate")
            mode, step = metric_key_prefix.removeprefix("eval_"), self.state.global_step
            measured = self._answers.measure(self.model, mode, dataloader.dataset, step)
            output.metrics.update({f"{metric_key_prefix}_{k}": v for k, v in measured.items()})
        return output

    def compute_loss(
        self,
        model: nn.Module,
        inputs: dict[str, Any],
        return_outputs: bool = False,
        **settings: Any,
    ) -> Any:
        """Raise UserError for a non-finite loss, after the ids of its samples are written."""
        ids = inputs.pop("sample_ids")
        if self._vision_cache is not None:
            self._vision_cache.encode_media(inputs)
        result = super().compute_loss(model, inputs, return_outputs, **settings)
        loss = result[0] if return_outputs else result
        if not torch.isfinite(loss):
            self._stop("loss", loss.item(), ids)
        if model.training:
            self._step_samples += ids
        return result

    def log(self, logs: dict[str, float], *args: Any, **settings: Any) -> None:
        """Raise UserError for a non-finite gradient, before the resulting weights are saved."""
        super().log(logs, *args, **settings)
        if "grad_norm" in logs:
            ids, self._step_samples = self._step_samples, []
            if not math.isfinite(logs["grad_norm"]):
                self._stop("gradient", logs["grad_norm"], ids)

    def _stop(self, what: str, value: float, ids: list[str]) -> NoReturn:
        name = f"{rank()}-{STOPPED}" if rank() else STOPPED
        step, path = self.state.global_step, Path(self.args.output_dir) / name
        write_json(path, {"step": step, what: str(value), "samples": ids})
        raise UserError(
            f"non-finite {what} ({value}) after step {step}; {path} lists the samples. Lower "
            "train.lr or set train.precision=fp32, in another run (run=NAME); checkpoints up to "
            "this step are kept",
            code=f"non-finite-{what}",
        )


def prefetch_factor(workers: int, accumulation: int) -> int | None:
    """Return the number of batches that each worker prepares in advance; None without workers.

    The trainer requests all micro-batches of an optimizer step at once. Together, the workers
    prepare at least as many in advance, so that they are ready when the previous step ends.
    """
    return max(2, math.ceil(accumulation / workers)) if workers else None


def student_arguments(
    train: StudentTrainConfig, run: Run, seed: int, checkpoint: Path | None, all_weights: bool
) -> TrainingArguments:
    """Return the arguments of a student's trainer.

    Args:
        train: The settings; `precision` is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.
        all_weights: Whether all weights are trained, not only adapters.
    """
    accumulation = split_batch(train.batch, train.micro_batch)
    return TrainingArguments(
        **common_arguments(train, run, seed, checkpoint),
        per_device_train_batch_size=train.micro_batch,
        gradient_accumulation_steps=accumulation,
        per_device_eval_batch_size=train.micro_batch,
        dataloader_prefetch_factor=prefetch_factor(train.workers, accumulation),
        label_names=["labels"],
        # Every pass uses all adapters. If all weights are trained, prompts without images leave
        # those of the vision tower unused.
        ddp_find_unused_parameters=all_weights,
    )


def build_trainer(
    cfg: SftCommand,
    run: Run,
    model: nn.Module,
    processor: ProcessorMixin,
    training: StudentDataset,
    validation: dict[str, StudentDataset],
    checkpoint: Path | None,
) -> StudentTrainer:
    """Audit the model and the longest sample, and return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: the model does not fit its preset, the longest sample is too long, or
            train.reuse_features is set and the vision tower is trained or sharded.
    """
    train, student = cfg.train, cfg.student
    collator = Collator(processor, student.max_length)
    lengths = training.lengths(processor, student.image_size)
    longest = training[lengths.index(max(lengths))]
    log.info(audit_student(model, processor, student, longest, collator))
    sampler = LengthSampler(
        lengths,
        training.item_ids,
        train.batch,
        cfg.seed,
        train.micro_batch,
        world_size(),
        pairs=train.micro_batch > 1 and shares_prompts(model),
    )
    cache = answers = None
    if train.reuse_features and not takes_clips(processor):
        log.info("train.reuse_features has no effect: only features of Qwen models are reused")
    elif train.reuse_features:
        # The ranks of this machine together cache up to half of its free memory.
        limit = available_cpu_bytes() // 2 // local_world_size()
        cache = VisionCache(model, train.precision, limit)
    if train.generated_items:
        answers = HeldOutAnswers(train, student, processor, run.folder)
    return StudentTrainer(
        model=model,
        args=student_arguments(train, run, cfg.seed, checkpoint, not student.lora.rank),
        data_collator=TrainerCollator(collator, digests=cache is not None),
        train_dataset=training,
        eval_dataset=validation,
        compute_loss_func=LOSSES[train.weighting],
        callbacks=[EpochCallback(training, sampler)],
        sampler=sampler,
        accuracy=LetterAccuracy(letter_ids(processor)),
        answers=answers,
        vision_cache=cache,
    )
