"""The token ids that a student is trained on are those that it is asked with where it is served."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from transformers import AutoProcessor

from data.records import FPS
from models.loading import pin_sizes
from models.student.collator import Encoded, encode
from models.student.prompts import Sample, selection_sample
from tests.children import run_child
from tests.teacher.vllm_server import ENVIRONMENT

LENGTH = 1500


@pytest.fixture(scope="module")
def sample(micro_store, frames, student_cfg) -> Sample:
    item = micro_store.selection("train")[0]
    return selection_sample(item, "reasoning", "cot", frames, student_cfg.frames, "near\nAnswer: B")


def test_a_prompts_ids_are_those_of_its_parts(sample, processor) -> None:
    """Each text, time and mark is encoded by itself, as vLLM does. Since 5.10 transformers keeps
    the marks around a whole clip, which earlier releases replaced; vLLM goes by the release that
    it is installed with. A change on either side is a change of the prompt."""
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
        "video": [*start, *clip, *end],
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


@pytest.mark.slow
def test_vllm_builds_the_ids_that_are_trained_on(sample, saved_base, tmp_path) -> None:
    """vLLM's own processor, in its environment, given the served folder's files."""
    served = tmp_path / "served"
    shutil.copytree(saved_base, served)
    processor = AutoProcessor.from_pretrained(served)
    pin_sizes(processor, 96, 12)
    # As a run and an export write it.
    processor.save_pretrained(served)
    messages = [{"role": "user", "content": sample.content}]
    asked = processor.apply_chat_template(messages, tokenize=False, add_generation_prompt=True)
    np.savez(
        tmp_path / "asked.npz",
        text=asked,
        clip=sample.clip.pixels,
        metadata=json.dumps(sample.clip.metadata),
        images=np.stack(sample.images),
    )
    script = Path(__file__).with_name("vllm_prompt.py")
    command = [ENVIRONMENT / "bin" / "python", script, served, tmp_path / "asked.npz"]
    ids = json.loads(run_child(command, check=True).stdout.splitlines()[-1])
    assert prompt_ids(encode(sample, processor, LENGTH)) == ids
