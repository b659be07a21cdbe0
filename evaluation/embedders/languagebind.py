"""LanguageBind: a video tower and an image tower, bound to one language tower.

transformers has no class of it, and what its authors offer for it needs an older transformers. Its
image and language towers are CLIP's. Its video tower is CLIP's too, with an attention over time
before each layer, which stands here; the weights keep the names that they were released with.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer
from transformers.models.clip.modeling_clip import CLIPAttention, CLIPEncoderLayer
from transformers.utils import logging as transformers_logging

from conf.errors import UserError
from conf.schema import RetrieverConfig
from evaluation.embedders.dual_encoder import (
    DualEncoder,
    as_array,
    at_once,
    check_size,
    check_words,
    pixel_values,
    unit_rows,
    whole,
)
from models.loading import UNREADABLE, check_reachable, load_error


class TimedLayer(CLIPEncoderLayer):
    """A layer of CLIP's that first attends, at each place of the image, over the clip's frames."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.temporal_embedding = nn.Parameter(torch.zeros(1, config.num_frames, self.embed_dim))
        self.temporal_layer_norm1 = nn.LayerNorm(self.embed_dim, eps=config.layer_norm_eps)
        self.temporal_attn = CLIPAttention(config)

    def forward(self, hidden_states: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        """`hidden_states` (clips x frames, places, width), a clip's frames one after the other."""
        times, places = self.temporal_embedding.shape[1], hidden_states.shape[1]
        over_time = hidden_states.unflatten(0, (-1, times)).transpose(1, 2).flatten(0, 1)
        over_time = over_time + self.temporal_embedding
        attended, _ = self.temporal_attn(self.temporal_layer_norm1(over_time))
        over_time = over_time + attended
        by_frame = over_time.unflatten(0, (-1, places)).transpose(1, 2).flatten(0, 1)
        return super().forward(by_frame, *args, **kwargs)


class LanguageBindVideo(CLIPModel):
    """CLIP with layers that attend over time; `get_image_features` takes the frames of whole clips
    and gives each frame's features, whose mean is the clip's."""

    def __init__(self, config: CLIPConfig) -> None:
        super().__init__(config)
        layers = range(config.vision_config.num_hidden_layers)
        self.vision_model.encoder.layers = nn.ModuleList(
            TimedLayer(config.vision_config) for _ in layers
        )
        self.post_init()


def load_languagebind(preset: RetrieverConfig, precision: str) -> DualEncoder:
    """The video and language towers of `model`, and the image tower of `image_model`. A query is
    the sum of its prefix's and its question's unit embeddings.

    Raises:
        UserError: a model is not on this machine and cannot be fetched, is no such model, lacks a
            part, or takes another number or size of frames.
    """
    check_reachable("retriever", preset.model)
    check_reachable("retriever", preset.image_model, "image_model")
    video_config = _config(preset.model, preset.revision, "model")
    times = getattr(video_config.vision_config, "num_frames", None)
    if not _is_of_videos(video_config):
        raise UserError(
            f"retriever.model={preset.model} has no attention over time: give a LanguageBind model "
            "of videos that was tuned whole, such as LanguageBind/LanguageBind_Video_FT"
        )
    if times != preset.frames:
        raise UserError(
            f"retriever.frames={preset.frames}, and {preset.model} takes clips of {times} frames: "
            f"give retriever.frames={times}"
        )
    image_config = _config(preset.image_model, preset.image_revision, "image_model")
    if _is_of_videos(image_config):
        raise UserError(
            f"retriever.image_model={preset.image_model} attends over time: give a LanguageBind "
            "model of images, such as LanguageBind/LanguageBind_Image"
        )
    check_size(preset, video_config)
    check_size(preset, image_config)
    try:
        origin = {"revision": preset.revision}
        tokenizer = CLIPTokenizer.from_pretrained(preset.model, **origin)
        video = whole(
            LanguageBindVideo, preset.model, precision, "model", config=video_config, **origin
        )
    except UNREADABLE as error:
        raise load_error("retriever", preset.model, error) from error
    try:
        origin = {"revision": preset.image_revision}
        image = whole(
            CLIPModel, preset.image_model, precision, "image_model", config=image_config, **origin
        )
    except UNREADABLE as error:
        raise load_error("retriever", preset.image_model, error, "image_model") from error
    check_words(preset, video_config, tokenizer)
    size = {"height": preset.image_size, "width": preset.image_size}
    # The released models have no file of this; their authors' transform is CLIP's.
    processor = CLIPImageProcessor(crop_size=size, size={"shortest_edge": preset.image_size})

    def watch(clips: list[np.ndarray]) -> np.ndarray:
        pixels = np.concatenate([clip[spread(len(clip), times)] for clip in clips])
        shown = pixel_values(processor, pixels)
        with torch.inference_mode():
            each = [
                as_array(video.get_image_features(**part).pooler_output)
                for part in at_once(shown, video, times)
            ]
        return unit_rows(np.concatenate(each).reshape(len(clips), times, -1).mean(axis=1))

    return DualEncoder(preset, image, video, tokenizer, processor, watch)


def spread(there: int, wanted: int) -> list[int]:
    """`wanted` of the numbers below `there`, evenly; some of them again where there are fewer."""
    return [int(k) for k in np.linspace(0, there - 1, wanted).round()]


def _is_of_videos(config: CLIPConfig) -> bool:
    return getattr(config.vision_config, "add_time_attn", False)


def _config(source: str, revision: str | None, key: str) -> CLIPConfig:
    # It says each time that the file is of a type of its own.
    before = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()
    try:
        return CLIPConfig.from_pretrained(source, revision=revision)
    except UNREADABLE as error:
        raise load_error("retriever", source, error, key) from error
    finally:
        transformers_logging.set_verbosity(before)
