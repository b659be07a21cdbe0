"""Prompts have the token ids of the released models' formats, which are written down here."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from sentence_transformers.sentence_transformer.modules import Transformer

from dynapix.models.compat import write_clips_as_released
from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import Clip, Sample, build_sample
from tests.families import (
    QWEN3_5_TEMPLATE,
    QWEN3_VL_TEMPLATE,
    QWEN3_VL_THINKING_TEMPLATE,
)

CLIP = (
    "<0.1 seconds><|vision_start|><|video_pad|><|vision_end|>"
    "<0.9 seconds><|vision_start|><|video_pad|><|vision_end|>"
)
"""Frames 0, 1, 4 and 5 at 5 frames per second."""
USER = (
    f"<|im_start|>user\n{CLIP}What comes?\nCandidate A: "
    "<|vision_start|><|image_pad|><|vision_end|>\nReply.<|im_end|>\n"
)
NO_THOUGHT = "<think>\n\n</think>\n\n"
FORMATS = {
    "instruct": (QWEN3_VL_TEMPLATE, False, f"{USER}<|im_start|>assistant\n"),
    "thinking": (QWEN3_VL_THINKING_TEMPLATE, True, f"{USER}<|im_start|>assistant\n<think>\n"),
    "thinking model without a thought": (
        QWEN3_VL_THINKING_TEMPLATE, False, f"{USER}<|im_start|>assistant\n{NO_THOUGHT}",
    ),
    "hybrid, thinking": (QWEN3_5_TEMPLATE, True, f"{USER}<|im_start|>assistant\n<think>\n"),
    "hybrid, not thinking": (
        QWEN3_5_TEMPLATE, False, f"{USER}<|im_start|>assistant\n{NO_THOUGHT}",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def small(processor):
    """A processor whose pictures have one visual token."""
    small = copy.deepcopy(processor)
    step = small.image_processor.patch_size * small.image_processor.merge_size
    for part, frames in ((small.image_processor, 1), (small.video_processor, 4)):
        part.size = {"shortest_edge": 1, "longest_edge": frames * step * step}
    return small


@pytest.mark.parametrize("form", FORMATS)
def test_a_prompt_has_the_token_ids_of_a_released_format(small, form) -> None:
    template, thinking, expected = FORMATS[form]
    small = released(small, template)
    encoded = encode(picture_sample(), small, None, thinking)
    assert small.tokenizer.decode(encoded.input_ids) == expected
    assert encoded.input_ids == small.tokenizer.encode(expected)


def test_a_retrieval_query_has_the_token_ids_of_the_released_embedding_format(
    small, tmp_path, saved_base
) -> None:
    """The instruction is the system message, and a generation prompt follows."""
    backbone = Transformer(
        saved_base,
        processing_kwargs={
            "video": {"do_sample_frames": False}, "chat_template": {"add_generation_prompt": True},
        },
    )  # fmt: skip
    backbone.processor = released(small, QWEN3_VL_TEMPLATE)
    clip = picture_sample().clip
    array = torch.from_numpy(clip.pixels).permute(0, 3, 1, 2)
    query = {"video": {"array": array, "video_metadata": clip.metadata}, "text": "What comes?"}
    ids = backbone.preprocess([query], prompt="Retrieve.")["input_ids"][0].tolist()
    assert small.tokenizer.decode(ids) == (
        f"<|im_start|>system\nRetrieve.<|im_end|>\n<|im_start|>user\n{CLIP}What comes?<|im_end|>\n"
        "<|im_start|>assistant\n"
    )


def released(processor, template: str):
    changed = copy.deepcopy(processor)
    changed.chat_template = template
    write_clips_as_released(changed)
    return changed


def picture_sample() -> Sample:
    frame = np.zeros((32, 32, 3), np.uint8)
    clip = Clip(np.stack([frame] * 4), [0, 1, 4, 5], fps=5.0, total=8)
    parts = ["What comes?", "\nCandidate A: ", frame, "\nReply."]
    return build_sample("item", parts, None, clip)
