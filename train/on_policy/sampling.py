"""Sample the responses of a student that is trained on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.nn.functional import log_softmax
from transformers import ProcessorMixin, SuppressTokensLogitsProcessor

from dynapix.conf.errors import UserError
from dynapix.conf.schema import DistillTrainConfig, ReinforceTrainConfig, StudentConfig
from dynapix.data.parallel import batched
from dynapix.models.memory import explain_out_of_memory
from dynapix.models.student.collator import Encoded, encode, pad
from dynapix.models.student.generation import GumbelNoise, generate, sampling_processors
from dynapix.models.student.prompts import Sample
from dynapix.models.student.responses import GeneratedText

MAX_UNPARSED = 64
"""Number of consecutive responses without an answer after which a run stops."""


@dataclass(frozen=True)
class EncodedPrompt:
    """A prompt, and the tokens and pixels that the model reads. A step encodes each prompt once,
    in a worker of the data loader, and all its passes use the result."""

    sample: Sample
    encoded: Encoded


def encode_prompt(sample: Sample, processor: ProcessorMixin, max_length: int) -> EncodedPrompt:
    """Encode a prompt. Raises UserError if it has more than `max_length` tokens."""
    return EncodedPrompt(sample, encode(sample, processor, max_length))


class RecordedNoise(GumbelNoise):
    """Gumbel noise that records the log-probabilities (B,) of the tokens that it chooses at each
    position."""

    def __init__(self, seeds: Sequence[int]) -> None:
        super().__init__(seeds)
        self.positions: list[Tensor] = []

    def __call__(self, input_ids: torch.LongTensor, scores: torch.FloatTensor) -> torch.FloatTensor:
        noisy = super().__call__(input_ids, scores)
        chosen = noisy.argmax(dim=-1, keepdim=True)
        self.positions.append(log_softmax(scores.float(), dim=-1).gather(1, chosen)[:, 0])
        return noisy


class ResponseSampler:
    """Samples a student's responses, each with its own seed.

    Args:
        student: Settings of the student; those of sampling are replaced.
    """

    def __init__(
        self,
        processor: ProcessorMixin,
        student: StudentConfig,
        train: DistillTrainConfig | ReinforceTrainConfig,
    ) -> None:
        self._processor, self._precision = processor, train.precision
        self._sampling = replace(
            student, temperature=train.temperature, top_p=1.0, top_k=0, thinking=False
        )
        self._batch = train.sampling_batch
        # The model would expect pixels for such a token in a response.
        self._never = [processor.image_token_id, processor.video_token_id]
        self._unparsed = 0

    def sample(
        self, model: nn.Module, prompts: Sequence[EncodedPrompt], seeds: Sequence[int]
    ) -> list[GeneratedText]:
        """Return a response to each prompt. The model is then in evaluation mode.

        Raises:
            UserError: Memory runs out.
        """
        model.eval()
        size = self._batch or max(len(prompts), 1)
        when = f"while sampling {min(size, len(prompts))} responses at once"
        advice = "lower train.sampling_batch, and run the same command: the run goes on"
        with explain_out_of_memory(when, advice):
            chunks = zip(batched(prompts, size), batched(seeds, size), strict=True)
            return [text for chunk in chunks for text in self._sample_at_once(model, *chunk)]

    def _sample_at_once(
        self, model: nn.Module, prompts: Sequence[EncodedPrompt], seeds: Sequence[int]
    ) -> list[GeneratedText]:
        inputs = pad([p.encoded for p in prompts], self._processor.tokenizer.pad_token_id)
        limit = self._sampling.max_new_tokens
        logits_processors = sampling_processors(self._sampling, seeds)
        noise = logits_processors[-1] = RecordedNoise(seeds)
        device = next(model.parameters()).device
        logits_processors.insert(0, SuppressTokensLogitsProcessor(self._never, device=device))
        texts = generate(model, self._processor, inputs, limit, self._precision, logits_processors)
        logs = torch.stack(noise.positions, dim=1).tolist()
        return [
            replace(text, log_probabilities=tuple(row[: len(text.ids)]))
            for text, row in zip(texts, logs, strict=True)
        ]

    def close(self) -> None:
        """Release what the sampler uses besides the model."""

    def check_parsed(self, letters: Sequence[str | None], accelerator: Accelerator) -> None:
        """Raise UserError on all ranks if `MAX_UNPARSED` responses in a row had no answer.

        Args:
            letters: The answers of this rank's responses in a step.
        """
        counts = torch.tensor([len(letters), sum(letter is not None for letter in letters)])
        total, parsed = accelerator.reduce(counts.to(accelerator.device)).tolist()
        self._unparsed = 0 if parsed else self._unparsed + total
        if self._unparsed >= MAX_UNPARSED:
            raise UserError(
                f"none of the last {self._unparsed} sampled responses has an answer: lower "
                "train.temperature or train.lr in another run (run=NAME), or train the student "
                "longer first",
                code="nothing-parsed",
            )
