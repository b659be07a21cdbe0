"""On-policy distillation: a teacher that reads the facts of an item scores the student's own texts.

Each step samples the student's response to each item of the batch. The loss is the divergence of
the student's distribution from the teacher's at each token of these responses. The student sees the
frames of the item; the teacher reads its facts as text. No gradient flows through the sampling.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import log_softmax
from transformers import ProcessorMixin

from conf.errors import UserError
from conf.runs import Run, world_size
from conf.schema import DistillCommand, DistillTrainConfig, SftCommand, StudentConfig
from models import distributed, loading
from models.memory import explain_out_of_memory
from models.student.answer_parser import parse_choice
from models.student.collator import IGNORED, Collator, letter_ids
from models.student.generation import generate, sampling_processors
from models.student.prompts import Sample
from models.student.responses import GeneratedText
from models.trained_runs import product_folder, trained_settings
from train.common.audit import audit_student
from train.common.callbacks import EpochCallback
from train.student.divergence import measure_divergence
from train.student.held_out_answers import HeldOutAnswers
from train.student.lazy_samples import StudentDataset
from train.student.length_sampler import LengthSampler
from train.student.metrics import LetterAccuracy
from train.student.paired_prompts import PairedPrompts
from train.student.run import student_arguments
from train.student.trainer import StudentTrainer, TrainerCollator, token_mean

log = logging.getLogger(__name__)

TEACHER = "teacher_inputs"
"""Key of the teacher's inputs in a batch."""
PATIENCE = 64
"""Number of sampled responses after which a run stops if none of them has an answer."""


@dataclass(frozen=True)
class DistillationCollator:
    """Passes on the samples of training batches, which get their responses later; validation
    samples become tensors."""

    collate: TrainerCollator

    def __call__(self, samples: Sequence[Sample | PairedPrompts]) -> dict[str, Any]:
        if isinstance(samples[0], PairedPrompts):
            return {"samples": list(samples)}
        return self.collate(samples)


class ResponseSampler:
    """Samples a student's responses, each with its own seed.

    Args:
        student: Settings of the student; those of sampling are replaced.
    """

    def __init__(
        self, processor: ProcessorMixin, student: StudentConfig, train: DistillTrainConfig
    ) -> None:
        self._processor, self._precision = processor, train.precision
        self._sampling = replace(student, temperature=train.temperature, top_p=1.0, top_k=0)
        self._collate = Collator(processor, student.max_length)

    def sample(self, model: nn.Module, samples: Sequence[PairedPrompts]) -> list[GeneratedText]:
        """Return a response to each student's prompt.

        Raises:
            UserError: Memory runs out.
        """
        model.eval()
        inputs = self._collate([s.student for s in samples])
        processors = sampling_processors(self._sampling, [s.seed for s in samples])
        limit = self._sampling.max_new_tokens
        with explain_out_of_memory(
            f"while sampling {len(samples)} responses",
            "lower train.batch in another run (run=NAME)",
        ):
            return generate(model, self._processor, inputs, limit, self._precision, processors)


class DistillationTrainer(StudentTrainer):
    """A student's trainer whose loss is the divergence from a teacher on sampled responses.

    Evaluations are those of `StudentTrainer`, with the narrator's rationales.

    Args:
        teacher: The teacher's model, which is not trained.
        responses: Samples the responses.
        student_collator, teacher_collator: Make the inputs of both models.
        weight: Weight of the teacher in the divergence (see `measure_divergence`).
    """

    def __init__(
        self,
        *args: Any,
        teacher: nn.Module,
        responses: ResponseSampler,
        student_collator: TrainerCollator,
        teacher_collator: Collator,
        weight: float,
        **settings: Any,
    ) -> None:
        super().__init__(*args, compute_loss_func=self._mean_divergence, **settings)
        self._teacher, self._responses = teacher, responses
        self._student_collator, self._teacher_collator = student_collator, teacher_collator
        self._weight = weight
        self._teacher_logits: Tensor | None = None
        self._sampled: list[tuple[bool, bool, int]] = []
        self._unparsed = 0

    def get_batch_samples(
        self, epoch_iterator: Iterator, num_batches: int, device: torch.device
    ) -> tuple[list, Tensor | int | None]:
        """Sample the responses of a step, and return its micro-batches with them."""
        batches, _ = super().get_batch_samples(epoch_iterator, num_batches, device)
        parts = [batch["samples"] for batch in batches]
        texts = iter(self._sample_responses([s for part in parts for s in part]))
        batches = [self._add_responses(part, [next(texts) for _ in part]) for part in parts]
        return batches, self._get_num_items_in_batch(batches, device)

    def _sample_responses(self, samples: Sequence[PairedPrompts]) -> list[GeneratedText]:
        texts = self._responses.sample(self.model, samples) if samples else []
        for sample, text in zip(samples, texts, strict=True):
            letter = parse_choice(text.text, cut=text.cut).letter
            self._unparsed = 0 if letter else self._unparsed + 1
            self._sampled.append((letter == sample.letter, letter is not None, len(text.ids)))
        if self._unparsed >= PATIENCE:
            raise UserError(
                f"none of the last {self._unparsed} sampled responses has an answer: lower "
                "train.temperature or train.lr in another run (run=NAME), or train the student "
                "longer first",
                code="nothing-parsed",
            )
        return texts

    def _add_responses(
        self, samples: Sequence[PairedPrompts], texts: Sequence[GeneratedText]
    ) -> dict[str, Any]:
        """Return the inputs of student and teacher. The labels of both are the responses."""

        def respond(prompts: Sequence[Sample]) -> list[Sample]:
            return [
                replace(p, response=t.text, response_ids=t.ids, supervised=s.supervised)
                for p, t, s in zip(prompts, texts, samples, strict=True)
            ]

        teacher = self._teacher_collator(respond([s.teacher for s in samples]))
        teacher.pop("labels", None)
        student = self._student_collator(respond([s.student for s in samples]))
        return {**student, TEACHER: teacher}

    def compute_loss(
        self,
        model: nn.Module,
        inputs: dict[str, Any],
        return_outputs: bool = False,
        **settings: Any,
    ) -> Any:
        teacher = inputs.pop(TEACHER, None)
        if teacher is not None:
            with torch.no_grad():
                self._teacher_logits = self._teacher(**teacher, use_cache=False).logits
        return super().compute_loss(model, inputs, return_outputs, **settings)

    def _mean_divergence(
        self, outputs: Any, labels: Tensor, num_items_in_batch: Tensor | int | None = None
    ) -> Tensor:
        """Return a micro-batch's part of the mean divergence over an accumulated batch's tokens;
        in an evaluation, of the mean cross entropy."""
        teacher, self._teacher_logits = self._teacher_logits, None
        if teacher is None:
            return token_mean(outputs, labels, num_items_in_batch)
        supervised = labels[:, 1:] != IGNORED
        # A larger model's table of tokens may be padded to another size.
        width = min(outputs.logits.shape[-1], teacher.shape[-1])
        student, teacher = (
            log_softmax(logits[:, :-1][supervised][:, :width].float(), dim=-1)
            for logits in (outputs.logits, teacher)
        )
        total = measure_divergence(student, teacher, self._weight).sum()
        return total / (supervised.sum() if num_items_in_batch is None else num_items_in_batch)

    def log(self, logs: dict[str, float], *args: Any, **settings: Any) -> None:
        """Add the measures of the responses that were sampled since the last training loss."""
        if "loss" in logs and self._sampled:
            right, parsed, tokens = (sum(values) for values in zip(*self._sampled, strict=True))
            count = len(self._sampled)
            logs |= {
                "sampled_right": right / count,
                "sampled_parsed": parsed / count,
                "sampled_tokens": tokens / count,
            }
            self._sampled = []
        super().log(logs, *args, **settings)


def load_teacher(cfg: DistillCommand, trained: SftCommand, processor: ProcessorMixin) -> nn.Module:
    """Load the teacher, in evaluation mode.

    Args:
        processor: The student's processor.

    Raises:
        UserError: The teacher has another tokenizer, or its run cannot be loaded.
    """
    folder = Path(cfg.teacher_model or cfg.model)
    settings = trained_settings(folder, SftCommand, "student", "teacher_model")
    weights = product_folder(folder, "student")
    model, other = loading.load_trained(settings.student, cfg.train.precision, weights)
    check_tokenizer(folder, processor, other)
    return model.to(distributed.rank_device())


def check_tokenizer(folder: Path, student: ProcessorMixin, teacher: ProcessorMixin) -> None:
    """Raise UserError if a teacher divides texts into other tokens than the student."""
    ours, theirs = (p.tokenizer.get_vocab() for p in (student, teacher))
    if ours == theirs:
        return
    differing = {token for token, _ in ours.items() ^ theirs.items()}
    first = min(differing, key=lambda token: ours.get(token, theirs.get(token)))
    raise UserError(
        f"teacher_model={folder} has another tokenizer than the student: the first token that "
        f"differs is {first!r} (id {ours.get(first)} in the student, {theirs.get(first)} in the "
        "teacher); choose a teacher of the student's family",
        code="other-tokenizer",
    )


def build_trainer(
    cfg: DistillCommand,
    trained: SftCommand,
    run: Run,
    model: nn.Module,
    teacher: nn.Module,
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
    """
    train, student = cfg.train, trained.student
    collator = Collator(processor, student.max_length)
    held_out = validation["reasoning"]
    lengths = held_out.lengths(processor, student.image_size)
    longest = held_out[lengths.index(max(lengths))]
    log.info(audit_student(model, processor, student, longest, collator))
    lengths = training.lengths(processor, student.image_size)
    sampler = LengthSampler(lengths, train.batch, cfg.seed, train.micro_batch, world_size())
    student_collator = TrainerCollator(collator, digests=False)
    answers = HeldOutAnswers(train, student, processor, run.folder)
    return DistillationTrainer(
        model=model,
        args=student_arguments(train, run, cfg.seed, checkpoint, not student.lora.rank),
        data_collator=DistillationCollator(student_collator),
        train_dataset=training,
        eval_dataset=validation,
        callbacks=[EpochCallback(training, sampler)],
        sampler=sampler,
        accuracy=LetterAccuracy(letter_ids(processor)),
        answers=answers if train.generated_items else None,
        teacher=teacher,
        responses=ResponseSampler(processor, student, train),
        student_collator=student_collator,
        teacher_collator=collator,
        weight=train.weight,
    )
