"""Requests for responses to a student's prompts, in the format of vLLM's chat completions."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from dynapix.data.frames.frame_cache import encode_png
from dynapix.models.student.prompts import Clip, Sample

if TYPE_CHECKING:
    from dynapix.conf.schema import StudentConfig
    from dynapix.teacher.servers.capabilities import Messages, RequestFields


def build_messages(sample: Sample) -> Messages:
    """Return a sample as the messages of a chat request, with its frames as PNGs in base64.

    A clip becomes a video in vLLM's format, whose times `qwen_fields` contains.
    """
    images = iter(sample.images)
    parts: list[dict[str, Any]] = []
    for part in sample.content:
        if part["type"] == "text":
            parts.append(part)
        elif part["type"] == "image":
            parts.append(image_part(next(images)))
        else:
            frames = ",".join(map(_encode_png, sample.clip.pixels))
            url = f"data:video/jpeg;base64,{frames}"
            parts.append({"type": "video_url", "video_url": {"url": url}})
    return [{"role": "user", "content": parts}]


def image_part(pixels: np.ndarray) -> dict[str, Any]:
    """Return an (H, W, 3) uint8 image as a part of a message."""
    url = f"data:image/png;base64,{_encode_png(pixels)}"
    return {"type": "image_url", "image_url": {"url": url}}


def _encode_png(pixels: np.ndarray) -> str:
    return base64.b64encode(encode_png(Image.fromarray(pixels))).decode()


def find_difference(own: Sequence[int], served: Sequence[int], tokenizer: Any) -> str | None:
    """Return in words where a server's token ids of a prompt differ from ours; None if nowhere."""
    pairs = enumerate(zip_longest(own, served))
    position = next((k for k, (one, other) in pairs if one != other), None)
    if position is None:
        return None
    names = [
        repr(tokenizer.convert_ids_to_tokens(ids[position])) if position < len(ids) else "no token"
        for ids in (own, served)
    ]
    return (
        f"at token {position} of the first prompt, this process has {names[0]} and the server "
        f"{names[1]} ({len(own)} and {len(served)} tokens)"
    )


def sampling_fields(student: StudentConfig, limit: int) -> RequestFields:
    """Return the fields of a request for sampling, without any penalty.

    Args:
        limit: Maximum number of new tokens.
    """
    # Fields that are left out would have the values of the model's generation_config.json.
    extra: dict[str, Any] = {
        "chat_template_kwargs": {"enable_thinking": student.thinking},
        "min_p": 0.0,
        "repetition_penalty": 1.0,
    }
    if student.temperature:
        # -1 sets no limit.
        extra["top_k"] = student.top_k or -1
    return {
        "temperature": student.temperature,
        "top_p": student.top_p,
        "presence_penalty": 0.0,
        "frequency_penalty": 0.0,
        "max_tokens": limit,
        "extra_body": extra,
    }


def qwen_fields(student: StudentConfig, clip: Clip | None) -> RequestFields:
    """Return the fields in `extra_body` for a Qwen model on vLLM.

    The server keeps all frames of a clip, with their true times. It resizes a frame only to the
    nearest size on the grid of the vision tower, as a local model does (see
    `models.loading.pin_sizes`).
    """
    # Both edges are numbers of pixels.
    max_pixels = 2 * student.image_size**2
    images = {"size": {"shortest_edge": 1, "longest_edge": max_pixels}}
    videos = {"size": {"shortest_edge": 1, "longest_edge": max_pixels * student.frames}}
    fields: RequestFields = {
        "mm_processor_kwargs": {
            "images_kwargs": images,
            "videos_kwargs": {**videos, "do_sample_frames": False},
        }
    }
    if clip:
        fields["media_io_kwargs"] = {"video": {"num_frames": -1, **clip.metadata}}
    return fields
