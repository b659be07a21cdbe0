"""Conversations become tensors: prompt ids from the processor, labels on the assistant's tokens.

The prompt's ids are exactly those that the processor gives at inference. The response is encoded
on its own and appended, so what is supervised is what has to be generated, token for token.
Batches are padded on the left, so that the supervised tokens stand together at the end and only
their rows pass the head.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from transformers import ProcessorMixin
from transformers.video_utils import VideoMetadata

from conf.errors import UserError
from data.records import LETTERS
from models.student.prompts import Sample, answer_line

IGNORED = -100
"""The label of a token that is not supervised, as torch's cross entropy has it."""


@dataclass(frozen=True)
class Encoded:
    """One conversation's token ids, labels and media tensors, unpadded."""

    input_ids: list[int]
    labels: list[int]
    mm_token_type_ids: list[int]
    media: dict[str, torch.Tensor]


def encode(
    sample: Sample, processor: ProcessorMixin, max_length: int, thinking: bool = False
) -> Encoded:
    """Token ids and pixels of a conversation; without a response, of its prompt alone. `thinking`
    is told to chat templates that know of it.

    Raises:
        UserError: it is longer than `max_length` tokens. It is never cut, since a cut could fall
            within a frame.
    """
    # What a template does not know of would be taken for the processor's.
    known = "enable_thinking" in str(processor.chat_template)
    text = processor.apply_chat_template(
        [{"role": "user", "content": sample.content}],
        tokenize=False,
        add_generation_prompt=True,
        **({"enable_thinking": thinking} if known else {}),
    )
    prompt = processor(
        text=[text],
        images=sample.images or None,
        videos=[sample.clip.pixels] if sample.clip else None,
        video_metadata=[VideoMetadata(**sample.clip.metadata)] if sample.clip else None,
        do_sample_frames=False,
        return_tensors="pt",
    )
    ids = prompt.pop("input_ids")[0].tolist()
    types = prompt.pop("mm_token_type_ids")[0].tolist()
    prompt.pop("attention_mask")
    response = []
    if sample.response is not None:
        response = processor.tokenizer.encode(sample.response, add_special_tokens=False)
        response.append(processor.tokenizer.eos_token_id)
    if len(ids) + len(response) > max_length:
        raise UserError(
            f"sample {sample.sample_id} has {len(ids) + len(response)} tokens, more than "
            f"student.max_length={max_length}: raise it, or lower student.image_size or "
            "student.frames"
        )
    media = {name: prompt[name] for name in MEDIA_INPUTS if name in prompt}
    labels = [IGNORED] * len(ids) + response
    return Encoded(ids + response, labels, types + [0] * len(response), media)


MEDIA = {
    "image": ("pixel_values", "image_grid_thw"),
    "video": ("pixel_values_videos", "video_grid_thw"),
}
"""What the processor gives of each kind of media: its pixels and their grid."""
MEDIA_INPUTS = tuple(name for names in MEDIA.values() for name in names)


class Collator:
    """Makes a batch of conversations: what the model's `forward` takes, and `labels`.

    `labels` (B, K) belong to the last K positions, which `logits_to_keep` (K,) names; position j's
    logits predict label j + 1.
    """

    def __init__(self, processor: ProcessorMixin, max_length: int, thinking: bool = False) -> None:
        self._processor = processor
        self._max_length = max_length
        self._thinking = thinking

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length, self._thinking) for s in samples]
        batch = pad(encoded, self._processor.tokenizer.pad_token_id)
        labels = batch.pop("labels")
        if (labels == IGNORED).all():
            return batch
        # The position before the first supervised token predicts it.
        start = int((labels != IGNORED).any(dim=0).nonzero()[0]) - 1
        labels[[not s.supervised for s in samples]] = IGNORED
        batch["labels"] = labels[:, start:]
        batch["logits_to_keep"] = torch.arange(start, labels.shape[1])
        return batch

    def named(self, samples: Sequence[Sample]) -> dict[str, Any]:
        """The batch with its samples' ids, as `sample_ids`."""
        return {**self(samples), "sample_ids": [s.sample_id for s in samples]}


def pad(encoded: Sequence[Encoded], pad_id: int) -> dict[str, Any]:
    """Left-pad to the longest; media of all samples in order."""
    longest = max(len(e.input_ids) for e in encoded)

    def stack(rows: list[list[int]], filler: int) -> torch.Tensor:
        return torch.tensor([[filler] * (longest - len(r)) + r for r in rows])

    batch: dict[str, Any] = {
        "input_ids": stack([e.input_ids for e in encoded], pad_id),
        "attention_mask": stack([[1] * len(e.input_ids) for e in encoded], 0),
        "mm_token_type_ids": stack([e.mm_token_type_ids for e in encoded], 0),
        "labels": stack([e.labels for e in encoded], IGNORED),
    }
    return batch | stacked_media(encoded)


def stacked_media(encoded: Sequence[Encoded]) -> dict[str, torch.Tensor]:
    """The media tensors of all samples in order."""
    parts = {name: [e.media[name] for e in encoded if name in e.media] for name in MEDIA_INPUTS}
    return {name: torch.cat(found) for name, found in parts.items() if found}


def letter_ids(processor: ProcessorMixin) -> list[int]:
    """The token of each letter as it stands in an answer's line.

    Raises:
        UserError: the tokenizer splits a letter, so that no one token is the choice.
    """
    encode_text = processor.tokenizer.encode
    lines = [encode_text(answer_line(letter), add_special_tokens=False) for letter in LETTERS]
    last = [line[-1] for line in lines]
    if len({tuple(line[:-1]) for line in lines}) != 1 or len(set(last)) != len(LETTERS):
        raise UserError(
            f"the tokenizer of {processor.tokenizer.name_or_path} does not give each answer "
            "letter one token of its own; student.model needs another tokenizer"
        )
    return last
