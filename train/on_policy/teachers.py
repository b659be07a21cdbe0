"""Teachers of on-policy distillation, a model in this process or one on servers, and how far a
student is from them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import log_softmax
from transformers import PreTrainedTokenizerBase, ProcessorMixin

from dynapix.conf.errors import UserError
from dynapix.conf.schema import DistillCommand, SftCommand, TeacherServerConfig
from dynapix.models import loading
from dynapix.models.distributed import rank_device
from dynapix.models.resolved_settings import check_base
from dynapix.models.student.collator import IGNORED, Collator, Encoded, encode
from dynapix.models.student.prompts import Sample
from dynapix.models.trained_runs import product_folder, read_trained_settings
from dynapix.teacher.servers.pool import NoResponseError, ServerPool, run_limited

PARTIAL_CHARACTER = "\N{REPLACEMENT CHARACTER}"
"""What a tokenizer decodes a token to that is a part of a character."""


def kl_divergence(log_p: Tensor, log_q: Tensor) -> Tensor:
    """Return the Kullback-Leibler divergence KL(p || q) (N,) of distributions (N, V), given as
    logarithms."""
    return (log_p.exp() * (log_p - log_q)).sum(dim=-1)


def estimate_divergence(student: Tensor, teacher: Tensor) -> Tensor:
    """Return estimates (N,) of the reverse Kullback-Leibler divergence KL(S || T) from one token
    each that was sampled from S. Over the tokens of S, the means of an estimate and of its gradient
    are the divergence and its gradient.

    Args:
        student: (N,) logarithms of the student's probabilities S of the tokens.
        teacher: (N,) logarithms of the teacher's probabilities T of the tokens.
    """
    difference = (student - teacher).detach()
    # The second term is 0. Its gradient is that of log S, weighted by the difference.
    return difference + difference * (student - student.detach())


class Teacher(Protocol):
    """Tells how far a student's distributions are from its own, at the tokens of responses."""

    def prepare(self, parts: Sequence[Sequence[Sample]]) -> list[Any]:
        """Return what `measure` needs for each micro-batch of a step.

        Args:
            parts: The teacher's prompts with the student's responses, by micro-batch.
        """
        ...

    def measure(self, prepared: Any, logits: Tensor, tokens: Tensor) -> Tensor:
        """Return the divergence (N,) at each of the N supervised tokens of a micro-batch.

        Args:
            prepared: What `prepare` returned for the micro-batch.
            logits: (N, V) logits of the student at these tokens.
            tokens: (N,) ids of these tokens.
        """
        ...


class LocalTeacher:
    """A model in this process, whose distributions are known whole."""

    def __init__(self, model: nn.Module, processor: ProcessorMixin, bf16: bool) -> None:
        self._model, self._bf16 = model, bf16
        # The sampled responses are limited by student.max_new_tokens already.
        self._collate = Collator(processor, None)

    def prepare(self, parts: Sequence[Sequence[Sample]]) -> list[dict[str, Any]]:
        """Return the inputs of the model."""
        return [self._collate(part) for part in parts]

    def measure(self, prepared: dict[str, Any], logits: Tensor, tokens: Tensor) -> Tensor:
        inputs = dict(prepared)
        supervised = inputs.pop("labels")[:, 1:] != IGNORED
        device = logits.device.type
        with torch.no_grad(), torch.autocast(device, torch.bfloat16, enabled=self._bf16):
            teacher = self._model(**inputs, use_cache=False).logits[:, :-1][supervised]
        # A larger model's table of tokens may be padded to another size.
        width = min(logits.shape[-1], teacher.shape[-1])
        ours, theirs = (log_softmax(x[:, :width].float(), dim=-1) for x in (logits, teacher))
        return kl_divergence(ours, theirs)


class ServerTeacher:
    """A model on servers, which return the log-probability of each token of a response. These give
    an unbiased estimate of the reverse Kullback-Leibler divergence."""

    def __init__(self, servers: TeacherServerConfig, processor: ProcessorMixin) -> None:
        self._servers, self._processor = servers, processor

    def prepare(self, parts: Sequence[Sequence[Sample]]) -> list[Tensor]:
        """Request the log-probabilities (N,) of the supervised tokens of each micro-batch.

        Raises:
            UserError: A server refuses a prompt, returns no log-probabilities of prompts, or has
                another tokenizer than the student.
        """
        samples = [sample for part in parts for sample in part if sample.supervised]
        scores = iter(asyncio.run(self._score(samples)))
        return [
            torch.tensor([x for s in part if s.supervised for x in next(scores)]) for part in parts
        ]

    def measure(self, prepared: Tensor, logits: Tensor, tokens: Tensor) -> Tensor:
        student = log_softmax(logits.float(), dim=-1).gather(1, tokens[:, None])[:, 0]
        return estimate_divergence(student, prepared)

    async def _score(self, samples: Sequence[Sample]) -> list[list[float]]:
        """Return the log-probabilities of the tokens of each sample's response."""
        scores: list[list[float]] = [[] for _ in samples]
        async with ServerPool(self._servers, {}) as pool:

            async def score(index: int) -> None:
                sample = samples[index]
                encoded = encode(sample, self._processor, None)
                try:
                    scored = await pool.score(encoded.input_ids)
                except NoResponseError as error:
                    raise UserError(
                        f"teacher_server.model={self._servers.model} does not score the response "
                        f"to {sample.sample_id} ({error}): correct the cause and run the same "
                        "command again, which resumes",
                        code="no-response",
                    ) from error
                self._check_tokens(encoded, scored.tokens)
                start = _response_start(encoded)
                scores[index] = scored.log_probabilities[start:]

            await run_limited(range(len(samples)), self._servers.concurrency, score)
        return scores

    def _check_tokens(self, encoded: Encoded, served: Sequence[str]) -> None:
        """Raise UserError if a token of a response has another text on the server."""
        tokenizer = self._processor.tokenizer
        start = _response_start(encoded)
        for token_id, theirs in zip(encoded.input_ids[start:], served[start:], strict=True):
            ours = tokenizer.decode([token_id])
            if ours != theirs and PARTIAL_CHARACTER not in ours:
                raise UserError(
                    f"teacher_server.model={self._servers.model} has another tokenizer than the "
                    f"student: the token with id {token_id} is {ours!r} in the student and "
                    f"{theirs!r} on the server; choose a teacher of the student's family",
                    code="other-tokenizer",
                )


def _response_start(encoded: Encoded) -> int:
    return sum(label == IGNORED for label in encoded.labels)


def read_teacher_settings(cfg: DistillCommand, trained: SftCommand) -> tuple[Path, SftCommand]:
    """Return the folder and the settings of the run that trained the teacher.

    Args:
        trained: Settings of the student.

    Raises:
        UserError: The run cannot be read; or the teacher has another regime, vocabulary or
            benchmark than the student.
    """
    folder = Path(cfg.teacher_model or cfg.model)
    settings = read_trained_settings(folder, SftCommand, "student", "teacher_model")
    check_base(folder, settings.student)
    for name, ours, theirs in (
        ("train.regime", trained.train.regime, settings.train.regime),
        ("teacher.predicates", trained.teacher.predicates, settings.teacher.predicates),
        ("benchmark", trained.benchmark.store_name, settings.benchmark.store_name),
    ):
        if ours != theirs:
            raise UserError(
                f"teacher_model={folder} was trained with {name}={theirs}, and the student with "
                f"{ours}: train a teacher with the student's setting",
                code="other-settings",
            )
    return folder, settings


def load_teacher(
    folder: Path, settings: SftCommand, precision: str, processor: ProcessorMixin
) -> nn.Module:
    """Load the model of a teacher, in evaluation mode.

    Args:
        settings: Settings of its run, in `folder`.
        processor: The student's processor.

    Raises:
        UserError: The teacher cannot be loaded, or has another tokenizer than the student.
    """
    weights = product_folder(folder, "student")
    model, other = loading.load_trained(settings.student, precision, weights)
    check_tokenizer(folder, processor.tokenizer, other.tokenizer)
    return model.to(rank_device())


def check_tokenizer(
    folder: Path, student: PreTrainedTokenizerBase, teacher: PreTrainedTokenizerBase
) -> None:
    """Raise UserError if a teacher divides texts into other tokens than the student."""
    ours, theirs = student.get_vocab(), teacher.get_vocab()
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
