"""Write a conversation in the chat format of a model's family.

A clip goes in as a video if the processor tells the model the true times of its frames, as those of
Qwen do. Otherwise its frames go in as images, each after its time as text.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from transformers import ProcessorMixin, Qwen2_5_VLProcessor, Qwen3VLProcessor

from dynapix.models.student.prompts import Sample
from dynapix.models.student.responses import THOUGHT_TAG

TIMED_PROCESSORS = (Qwen3VLProcessor, Qwen2_5_VLProcessor)
"""Processors that tell the times of a clip's frames: Qwen3-VL's as text before each pair of frames,
Qwen2.5-VL's as positions, from the mean distance between two frames."""
EMPTY_THOUGHT = f"{THOUGHT_TAG}\n\n</think>\n\n"
"""A thought without text, as templates write it that can turn thinking off."""


def takes_clips(processor: ProcessorMixin) -> bool:
    """Return whether clips go in as videos."""
    return isinstance(processor, TIMED_PROCESSORS)


def write_prompt(sample: Sample, processor: ProcessorMixin, thinking: bool) -> str:
    """Return the text of a prompt, with a placeholder for each image and clip.

    Without `thinking`, a prompt of a model that always thinks ends with an empty thought.
    """
    content = sample.content
    if sample.images and not _keeps_order(processor, str(processor.chat_template)):
        texts = [p["text"] if p["type"] == "text" else processor.image_token for p in content]
        content = [{"type": "text", "text": "".join(texts)}]
    # A variable that the template does not use would be passed on to the processor.
    options = {"enable_thinking": thinking}
    text = _render(
        processor,
        content,
        add_generation_prompt=True,
        **(options if "enable_thinking" in str(processor.chat_template) else {}),
    )
    opened = text.rstrip().removesuffix(THOUGHT_TAG)
    return text if thinking or opened == text.rstrip() else opened + EMPTY_THOUGHT


def find_end_token(processor: ProcessorMixin) -> int:
    """Return the id of the token that ends an assistant's turn in the chat template.

    It need not be the tokenizer's `eos_token`: Gemma ends a turn with `<end_of_turn>`.
    """
    return _find_end_token(processor, str(processor.chat_template))


# Every sample of a training needs the end token and the order, which take longer than its text.
@lru_cache(maxsize=8)
def _find_end_token(processor: ProcessorMixin, _template: str) -> int:
    response = "response"
    turn = {"role": "assistant", "content": [{"type": "text", "text": response}]}
    text = _render(processor, [{"type": "text", "text": "prompt"}], turn)
    tokenizer = processor.tokenizer
    ids = tokenizer.encode(text.rpartition(response)[2], add_special_tokens=False)
    special = {*tokenizer.all_special_ids, *tokenizer.added_tokens_decoder}
    return next((token for token in ids if token in special), tokenizer.eos_token_id)


@lru_cache(maxsize=8)
def _keeps_order(processor: ProcessorMixin, _template: str) -> bool:
    """Return whether the template writes texts and images in the order of a message's parts."""
    text = _render(processor, [{"type": "text", "text": "first"}, {"type": "image"}])
    return text.find("first") < text.find(processor.image_token)


def _render(
    processor: ProcessorMixin, content: Sequence[dict[str, Any]], *turns: Any, **options: Any
) -> str:
    conversation = [{"role": "user", "content": list(content)}, *turns]
    return processor.apply_chat_template(conversation, tokenize=False, **options)
