"""Prompts have the token ids of the released models' formats, which are written down here."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from dynapix.models.compat import write_clips_as_released
from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import Clip, build_sample
from tests.families import QWEN3_5_TEMPLATE, QWEN3_VL_TEMPLATE, QWEN3_VL_THINKING_TEMPLATE

CLIP = (
    "<0.1 seconds><|vision_start|><|video_pad|><|vision_end|>"
    "<0.9 seconds><|vision_start|><|video_pad|><|vision_end|>"
)
"""Frames 0, 1, 4 and 5 at 5 frames per second."""
PROMPT = (
    f"<|im_start|>user\n{CLIP}What comes?\nCandidate A: "
    "<|vision_start|><|image_pad|><|vision_end|>\nReply.<|im_end|>\n<|im_start|>assistant\n"
)
NO_THOUGHT = "<think>\n\n</think>\n\n"
FORMATS = {
    "instruct": (QWEN3_VL_TEMPLATE, False, PROMPT),
    "thinking": (QWEN3_VL_THINKING_TEMPLATE, True, f"{PROMPT}<think>\n"),
    "thinking model without a thought": (
        QWEN3_VL_THINKING_TEMPLATE, False, f"{PROMPT}{NO_THOUGHT}",
    ),
    "hybrid, thinking": (QWEN3_5_TEMPLATE, True, f"{PROMPT}<think>\n"),
    "hybrid, not thinking": (QWEN3_5_TEMPLATE, False, f"{PROMPT}{NO_THOUGHT}"),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMATS)
def test_a_prompt_has_the_token_ids_of_a_released_format(processor, form) -> None:
    template, thinking, expected = FORMATS[form]
    # A processor whose pictures have one visual token.
    small = copy.deepcopy(processor)
    step = small.image_processor.patch_size * small.image_processor.merge_size
    for part, frames in ((small.image_processor, 1), (small.video_processor, 4)):
        part.size = {"shortest_edge": 1, "longest_edge": frames * step * step}
    small.chat_template = template
    write_clips_as_released(small)
    frame = np.zeros((32, 32, 3), np.uint8)
    clip = Clip(np.stack([frame] * 4), [0, 1, 4, 5], fps=5.0, total=8)
    sample = build_sample("item", ["What comes?", "\nCandidate A: ", frame, "\nReply."], None, clip)
    encoded = encode(sample, small, None, thinking)
    assert small.tokenizer.decode(encoded.input_ids) == expected
    assert encoded.input_ids == small.tokenizer.encode(expected)
