"""On-policy distillation: a student is trained on its own responses towards a teacher.

Each step samples the student's response to each item of the batch. The loss is the divergence of
the student's distribution from the teacher's at each token of these responses. The student sees the
frames of the item; the teacher reads its facts as text. No gradient flows through the sampling.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from transformers import ProcessorMixin

from dynapix.conf.runs import Run, world_size
from dynapix.conf.schema import DistillCommand, SftCommand
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.student.collator import (
    IGNORED,
    Collator,
    append_response,
    letter_ids,
    make_batch,
)
from dynapix.models.student.prompts import Sample
from dynapix.models.student.responses import GeneratedText
from dynapix.train.common.audit import audit_student
from dynapix.train.common.callbacks import EpochCallback
from dynapix.train.on_policy.mismatch import Mismatch
from dynapix.train.on_policy.paired_prompts import PairedPrompts
from dynapix.train.on_policy.sampling import EncodedPrompt, ResponseSampler, encode_prompt
from dynapix.train.on_policy.served_sampling import build_sampler
from dynapix.train.on_policy.teachers import Teacher
from dynapix.train.student.held_out_answers import HeldOutAnswers
from dynapix.train.student.samples import LengthSampler, StudentDataset
from dynapix.train.student.trainer import (
    LetterAccuracy,
    StudentTrainer,
    TrainerCollator,
    student_arguments,
    token_mean,
)

log = logging.getLogger(__name__)

TEACHER = "teacher_inputs"
"""Key of the teacher's inputs in a batch."""
SAMPLED = "sampled_log_probabilities"
"""Key of the sampler's log-probabilities (N,) of the supervised tokens in a batch."""


@dataclass(frozen=True)
class DistillationCollator:
    """Encodes the student's prompts of training batches, which get their responses later;
    validation samples become tensors."""

    collate: TrainerCollator
    encode: Callable[[Sample], EncodedPrompt]

    def __call__(self, samples: Sequence[Sample | PairedPrompts]) -> dict[str, Any]:
        if isinstance(samples[0], PairedPrompts):
            encoded = [self.encode(prompts.student) for prompts in samples]
            return {"prompts": list(samples), "encoded": encoded}
        return self.collate(samples)


class DistillationTrainer(StudentTrainer):
    """A student's trainer whose loss is the divergence from a teacher on sampled responses.

    Evaluations are those of `StudentTrainer`, with the narrator's rationales as responses.

    Args:
        teacher: Measures the divergence.
        response_sampler: Samples the responses.
        pad_id: Token id of the padding.
        temperature: Temperature of the sampling.
    """

    def __init__(
        self,
        *args: Any,
        teacher: Teacher,
        response_sampler: ResponseSampler,
        pad_id: int,
        temperature: float,
        **settings: Any,
    ) -> None:
        super().__init__(*args, compute_loss_func=self._mean_divergence, **settings)
        self._teacher, self.response_sampler = teacher, response_sampler
        self._pad_id, self._temperature = pad_id, temperature
        self._teacher_inputs: Any = None
        self._sampled_logs = torch.zeros(0)
        self._mismatch = Mismatch()
        self._sampled: list[tuple[bool, bool, int]] = []

    def get_batch_samples(
        self, epoch_iterator: Iterator, num_batches: int, device: torch.device
    ) -> tuple[list, Tensor | int | None]:
        """Sample the responses of a step, and return its micro-batches with them."""
        batches, _ = super().get_batch_samples(epoch_iterator, num_batches, device)
        prompts = [p for batch in batches for p in batch["prompts"]]
        encoded = [e for batch in batches for e in batch["encoded"]]
        remaining = iter(self._sample_responses(prompts, encoded))
        texts = [[next(remaining) for _ in batch["prompts"]] for batch in batches]
        pairs = list(zip(batches, texts, strict=True))
        prepared = self._teacher.prepare([answer_teacher(*pair) for pair in pairs])
        batches = [
            {**answer_student(*pair, self._pad_id), TEACHER: inputs}
            for pair, inputs in zip(pairs, prepared, strict=True)
        ]
        return batches, self._get_num_items_in_batch(batches, device)

    def _sample_responses(
        self, prompts: Sequence[PairedPrompts], encoded: Sequence[EncodedPrompt]
    ) -> list[GeneratedText]:
        texts = []
        if prompts:
            seeds = [p.seed for p in prompts]
            texts = self.response_sampler.sample(self.model, encoded, seeds)
        letters = [parse_choice(t.text, truncated=t.truncated).letter for t in texts]
        counted = [k for k, prompt in enumerate(prompts) if prompt.supervised]
        self._sampled += [
            (letters[k] == prompts[k].letter, letters[k] is not None, len(texts[k].ids))
            for k in counted
        ]
        self.response_sampler.check_parsed([letters[k] for k in counted], self.accelerator)
        return texts

    def compute_loss(
        self,
        model: nn.Module,
        inputs: dict[str, Any],
        return_outputs: bool = False,
        **settings: Any,
    ) -> Any:
        self._teacher_inputs = inputs.pop(TEACHER, None)
        self._sampled_logs = inputs.pop(SAMPLED, None)
        return super().compute_loss(model, inputs, return_outputs, **settings)

    def _mean_divergence(
        self, outputs: Any, labels: Tensor, num_items_in_batch: Tensor | int | None = None
    ) -> Tensor:
        """Return a micro-batch's part of the mean divergence over an accumulated batch's tokens;
        in an evaluation, of the mean cross entropy."""
        if self._teacher_inputs is None:
            return token_mean(outputs, labels, num_items_in_batch)
        supervised = labels[:, 1:] != IGNORED
        logits, tokens = outputs.logits[:, :-1][supervised], labels[:, 1:][supervised]
        with torch.no_grad():
            scaled = logits.float() / self._temperature
            chosen = scaled.gather(1, tokens[:, None])[:, 0]
            self._mismatch.add(chosen - scaled.logsumexp(dim=-1) - self._sampled_logs)
            del scaled
        total = self._teacher.measure(self._teacher_inputs, logits, tokens).sum()
        return total / (supervised.sum() if num_items_in_batch is None else num_items_in_batch)

    def log(self, logs: dict[str, float], *args: Any, **settings: Any) -> None:
        """Add the measures of the responses that all ranks have sampled since the last loss."""
        if "loss" in logs:
            sums = [sum(values) for values in zip(*self._sampled, strict=True)] or [0, 0, 0]
            found = torch.tensor([len(self._sampled), *sums], dtype=torch.float64)
            found = self.accelerator.reduce(found.to(self.args.device, torch.float32))
            count, right, parsed, tokens = found.tolist()
            logs |= {
                "sampled_accuracy": right / max(count, 1),
                "sampled_parse_rate": parsed / max(count, 1),
                "sampled_length": tokens / max(count, 1),
                **self._mismatch.take(self.accelerator),
            }
            self._sampled = []
        super().log(logs, *args, **settings)


def answer_teacher(batch: dict[str, Any], texts: Sequence[GeneratedText]) -> list[Sample]:
    """Return the teacher's prompts of a micro-batch with the student's responses."""
    return [
        replace(p.teacher, response=t.text, response_ids=t.ids, supervised=p.supervised)
        for p, t in zip(batch["prompts"], texts, strict=True)
    ]


def answer_student(
    batch: dict[str, Any], texts: Sequence[GeneratedText], pad_id: int
) -> dict[str, Any]:
    """Return the student's inputs: its encoded prompts of a micro-batch with its responses."""
    prompts = batch["prompts"]
    answered = [
        append_response(e.encoded, t.ids, t.ids)
        for e, t in zip(batch["encoded"], texts, strict=True)
    ]
    supervised = [p.supervised for p in prompts]
    logs = [
        x for t, kept in zip(texts, supervised, strict=True) if kept for x in t.log_probabilities
    ]
    return {
        **make_batch(answered, supervised, pad_id),
        SAMPLED: torch.tensor(logs),
        "sample_ids": [p.student.sample_id for p in prompts],
    }


def build_trainer(
    cfg: DistillCommand,
    trained: SftCommand,
    run: Run,
    model: nn.Module,
    teacher: Teacher,
    processor: ProcessorMixin,
    training: StudentDataset,
    validation: dict[str, StudentDataset],
    checkpoint: Path | None,
) -> DistillationTrainer:
    """Audit the model and the longest validation sample, and return a trainer.

    Args:
        cfg: Settings whose train.precision is bf16 or fp32, not auto.
        trained: Settings of the student.
        checkpoint: The checkpoint that the run resumes from, or None.

    Raises:
        UserError: the model does not fit its preset, or the longest sample is too long.
    """
    train, student = cfg.train, trained.student
    collator = Collator(processor, student.max_length)
    lengths = validation["reasoning"].lengths(processor, student.image_size)
    longest = validation["reasoning"][lengths.index(max(lengths))]
    log.info(audit_student(model, processor, student, longest, collator))
    lengths = training.lengths(processor, student.image_size)
    sampler = LengthSampler(
        lengths, training.item_ids, train.batch, cfg.seed, train.micro_batch, world_size()
    )
    answers = HeldOutAnswers(train, student, processor, run.folder)
    return DistillationTrainer(
        model=model,
        args=student_arguments(train, run, cfg.seed, checkpoint, not student.lora.rank),
        data_collator=DistillationCollator(
            TrainerCollator(collator, digests=False),
            partial(encode_prompt, processor=processor, max_length=student.max_length),
        ),
        train_dataset=training,
        eval_dataset={mode: samples for mode, samples in validation.items() if len(samples)},
        callbacks=[EpochCallback(training, sampler)],
        sampler=sampler,
        accuracy=LetterAccuracy(letter_ids(processor)),
        answers=answers if train.generated_items else None,
        teacher=teacher,
        response_sampler=build_sampler(processor, student, train, cfg.sampling_server, run.folder),
        pad_id=processor.tokenizer.pad_token_id,
        temperature=train.temperature,
    )
