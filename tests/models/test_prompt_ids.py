"""A prompt has the token ids that vLLM gives its parts."""

from __future__ import annotations

import pytest

from data.records import FPS
from models.student.collator import Encoded, encode
from models.student.prompts import Sample, selection_sample

LENGTH = 1500


@pytest.fixture(scope="module")
def sample(micro_store, frames, student_cfg) -> Sample:
    item = micro_store.selection("train")[0]
    return selection_sample(item, "reasoning", "cot", frames, student_cfg.frames, "near\nAnswer: B")


def test_a_prompt_has_the_token_ids_of_its_parts(sample, processor) -> None:
    """Each text, timestamp and vision token is encoded separately, as in vLLM."""
    encoded = encode(sample, processor, LENGTH)
    text = processor.tokenizer.encode
    start, end = (text(f"<|vision_{mark}|>") for mark in ("start", "end"))
    _, rows, columns = (n // 2 for n in encoded.media["image_grid_thw"][0].tolist())
    patches = rows * columns
    indices = sample.clip.indices
    clip = []
    for one, two in zip(indices[::2], indices[1::2], strict=True):
        time = (one / FPS + two / FPS) / 2
        clip += [*text(f"<{time:.1f} seconds>"), *start, *text("<|video_pad|>") * patches, *end]
    shown = {
        "video": clip,
        "image": [*start, *text("<|image_pad|>") * patches, *end],
    }
    prompt = text("<|im_start|>") + text("user\n")
    words = ""
    for part in [*sample.content, {"type": "end"}]:
        if part["type"] == "text":
            words += part["text"]
            continue
        prompt += text(words) + shown.get(part["type"], [])
        words = ""
    prompt += text("<|im_end|>") + text("\n") + text("<|im_start|>") + text("assistant\n")
    assert prompt_ids(encoded) == prompt


def prompt_ids(encoded: Encoded) -> list[int]:
    return [i for i, x in zip(encoded.input_ids, encoded.labels, strict=True) if x < 0]
