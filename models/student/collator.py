"""Turn conversations into tensors, for any family of models.

The token ids of a prompt are the same in training and inference. The response is encoded separately
and appended, so that it consists of the tokens that the model has to generate. Batches are padded
on the left, so that the supervised tokens are the last ones of every row and the language head only
has to compute the logits of these positions.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn.utils.rnn import pad_sequence
from transformers import ProcessorMixin
from transformers.video_utils import VideoMetadata

from dynapix.conf.errors import UserError
from dynapix.data.records import LETTERS
from dynapix.models.student.chat_format import find_end_token, takes_clips, write_prompt
from dynapix.models.student.prompts import Clip, Sample, answer_line, show_frames_as_images

IGNORED = -100
"""Label of a token that is not in the loss: the default `ignore_index` of torch's cross-entropy."""
MEDIA = {
    "image": ("pixel_values", "image_grid_thw"),
    "video": ("pixel_values_videos", "video_grid_thw"),
}
"""The outputs of Qwen's processors for each kind of media: pixels and their grid."""


@dataclass(frozen=True)
class Encoded:
    """Token ids, labels and media tensors of one conversation, without padding.

    Attributes:
        token_types: The processor's other outputs with one value per token, such as Qwen's
            `mm_token_type_ids`. They are 0 in the response.
        media: The processor's outputs for images and clips.
    """

    input_ids: list[int]
    labels: list[int]
    token_types: dict[str, list[int]]
    media: dict[str, torch.Tensor]


def encode(
    sample: Sample, processor: ProcessorMixin, max_length: int | None, thinking: bool = False
) -> Encoded:
    """Encode a conversation; without a response, only its prompt.

    Args:
        max_length: Maximum number of tokens; None sets no limit.
        thinking: Whether the model may think before its response.

    Raises:
        UserError: The conversation has more than `max_length` tokens. It is not truncated, because
            an image could be cut.
    """
    if not takes_clips(processor):
        sample = show_frames_as_images(sample)
    prompt = processor(
        text=[write_prompt(sample, processor, thinking)],
        images=[sample.images] if sample.images else None,
        # The chat template has written the special tokens.
        add_special_tokens=False,
        return_tensors="pt",
        **(clip_inputs(sample.clip) if sample.clip else {}),
    )
    ids = prompt.pop("input_ids")[0].tolist()
    prompt.pop("attention_mask")
    if "second_per_grid_ts" in prompt:
        prompt["second_per_grid_ts"] = torch.tensor([pair_seconds(sample.clip)])
    types = {
        name: prompt.pop(name)[0].tolist() for name in list(prompt) if name.endswith("type_ids")
    }
    response, trained = [], []
    if sample.response_ids is not None:
        response = trained = list(sample.response_ids)
    elif sample.response is not None:
        encoded = processor.tokenizer(
            sample.response, add_special_tokens=False, return_offsets_mapping=True
        )
        response = [*encoded["input_ids"], find_end_token(processor)]
        trained = response.copy()
        stops = [stop for _, stop in encoded["offset_mapping"]]
        for first, stop in sample.false_spans:
            # A space belongs to the token of the next word, whether or not its offsets include it.
            tokens = slice(bisect_right(stops, first), bisect_right(stops, stop - 1) + 1)
            trained[tokens] = [IGNORED] * len(trained[tokens])
    if max_length is not None and len(ids) + len(response) > max_length:
        raise UserError(
            f"sample {sample.sample_id} has {len(ids) + len(response)} tokens, more than "
            f"student.max_length={max_length}: raise student.max_length, or lower "
            "student.image_size or student.frames; train.distill and train.reinforce take these "
            "settings from the run that model names",
            code="sample-too-long",
        )
    encoded = Encoded(ids, [IGNORED] * len(ids), types, dict(prompt))
    return append_response(encoded, response, trained)


def append_response(prompt: Encoded, ids: Sequence[int], labels: Sequence[int]) -> Encoded:
    """Return an encoded prompt with the tokens and the labels of a response."""
    types = {name: values + [0] * len(ids) for name, values in prompt.token_types.items()}
    return Encoded([*prompt.input_ids, *ids], [*prompt.labels, *labels], types, prompt.media)


def clip_inputs(clip: Clip) -> dict[str, Any]:
    """Return a processor's arguments for a clip with its true times."""
    return {
        "videos": [clip.pixels],
        "video_metadata": [VideoMetadata(**clip.metadata)],
        "do_sample_frames": False,
    }


def pair_seconds(clip: Clip) -> float:
    """Return the mean time (s) from a pair of a clip's frames to the next pair.

    Qwen2.5-VL's processor takes the clip for evenly spaced frames of the whole scene.
    """
    steps = max(1, len(clip.indices) - 1)
    return 2 * (clip.indices[-1] - clip.indices[0]) / steps / clip.fps


class Collator:
    """Encodes conversations and makes batches of them (see `make_batch`)."""

    def __init__(
        self, processor: ProcessorMixin, max_length: int | None, thinking: bool = False
    ) -> None:
        self._processor = processor
        self._max_length = max_length
        self._thinking = thinking

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        encoded = [encode(s, self._processor, self._max_length, self._thinking) for s in samples]
        supervised = [s.supervised for s in samples]
        return make_batch(encoded, supervised, self._processor.tokenizer.pad_token_id)


def make_batch(
    encoded: Sequence[Encoded], supervised: Sequence[bool], pad_id: int
) -> dict[str, Any]:
    """Return a left-padded batch of conversations: the tensors that the model's `forward` takes.

    Batches with responses also contain `labels` (B, K) for the last K positions, and the indices
    `logits_to_keep` (K,) of these positions. The logits at position j predict label j + 1.

    Args:
        supervised: Whether each conversation is trained on.
    """
    batch = pad(encoded, pad_id)
    labels = batch.pop("labels")
    if (labels == IGNORED).all():
        return batch
    # The logits that predict the first supervised token are at the position before it.
    start = int((labels != IGNORED).any(dim=0).nonzero()[0]) - 1
    labels[[not is_trained for is_trained in supervised]] = IGNORED
    batch["labels"] = labels[:, start:]
    batch["logits_to_keep"] = torch.arange(start, labels.shape[1])
    return batch


def pad(encoded: Sequence[Encoded], pad_id: int) -> dict[str, Any]:
    """Left-pad conversations to the longest one, and concatenate their media in order."""

    def stack(rows: Iterable[list[int]], filler: int) -> torch.Tensor:
        tensors = [torch.tensor(row) for row in rows]
        return pad_sequence(tensors, True, filler, padding_side="left")

    batch: dict[str, Any] = {
        "input_ids": stack((e.input_ids for e in encoded), pad_id),
        "attention_mask": stack(([1] * len(e.input_ids) for e in encoded), 0),
        "labels": stack((e.labels for e in encoded), IGNORED),
    }
    for name in encoded[0].token_types:
        batch[name] = stack((e.token_types[name] for e in encoded), 0)
    for name in {name: None for e in encoded for name in e.media}:
        batch[name] = concatenate([e.media[name] for e in encoded if name in e.media])
    return batch


def concatenate(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    """Concatenate tensors along the first dimension; smaller ones are padded with zeros."""
    largest = [max(sizes) for sizes in zip(*(t.shape[1:] for t in tensors), strict=True)]

    def enlarge(tensor: torch.Tensor) -> torch.Tensor:
        missing = [m - n for m, n in zip(largest, tensor.shape[1:], strict=True)]
        # Padding is given from the last dimension on, before and after the entries.
        return torch.nn.functional.pad(tensor, [k for m in reversed(missing) for k in (0, m)])

    return torch.cat([enlarge(tensor) for tensor in tensors])


def letter_ids(processor: ProcessorMixin) -> list[int]:
    """Return the ids of the tokens that stand for the letters in an answer line.

    Raises:
        UserError: The tokenizer has no single token for each letter.
    """
    encode_text = processor.tokenizer.encode
    lines = [encode_text(answer_line(letter), add_special_tokens=False) for letter in LETTERS]
    last = [line[-1] for line in lines]
    if len({tuple(line[:-1]) for line in lines}) != 1 or len(set(last)) != len(LETTERS):
        raise UserError(
            f"the tokenizer of {processor.tokenizer.name_or_path} has no single token for each "
            "answer letter: choose a student.model with another tokenizer",
            code="unsuitable-tokenizer",
        )
    return last
