"""LanguageBind: a video tower and an image tower that embed into the space of one text tower.

transformers has no class for it, and its authors' code needs an older transformers. Its image and
text towers are those of CLIP. Its video tower is CLIP's image tower with attention over time before
each layer. It is implemented here with the names of the released weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer
from transformers.models.clip.modeling_clip import CLIPAttention, CLIPEncoderLayer

from dynapix.conf.errors import UserError
from dynapix.conf.schema import RetrieverConfig
from dynapix.evaluation.embedders.dual_encoder import (
    DualEncoder,
    check_size,
    check_tokenizer,
    image_features,
    load_complete,
    unit_rows,
)
from dynapix.models.loading import explain_unloadable


class TemporalLayer(CLIPEncoderLayer):
    """A CLIP layer after attention over time: each image position attends over a clip's frames."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.temporal_embedding = nn.Parameter(torch.zeros(1, config.num_frames, self.embed_dim))
        self.temporal_layer_norm1 = nn.LayerNorm(self.embed_dim, eps=config.layer_norm_eps)
        self.temporal_attn = CLIPAttention(config)

    def forward(self, hidden_states: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        """`hidden_states` is (clips x frames, positions, width), with a clip's frames in a row."""
        frames, positions = self.temporal_embedding.shape[1], hidden_states.shape[1]
        over_time = hidden_states.unflatten(0, (-1, frames)).transpose(1, 2).flatten(0, 1)
        over_time = over_time + self.temporal_embedding
        attended, _ = self.temporal_attn(self.temporal_layer_norm1(over_time))
        over_time = over_time + attended
        by_frame = over_time.unflatten(0, (-1, positions)).transpose(1, 2).flatten(0, 1)
        return super().forward(by_frame, *args, **kwargs)


class LanguageBindVideo(CLIPModel):
    """CLIP with attention over time.

    `get_image_features` takes the frames of complete clips and returns the features of each frame.
    The embedding of a clip is the mean of its frames' features.
    """

    def __init__(self, config: CLIPConfig) -> None:
        super().__init__(config)
        layers = range(config.vision_config.num_hidden_layers)
        self.vision_model.encoder.layers = nn.ModuleList(
            TemporalLayer(config.vision_config) for _ in layers
        )
        self.post_init()


def load_languagebind(preset: RetrieverConfig, precision: str) -> DualEncoder:
    """Load the video and text towers of `model`, and the image tower of `image_model`."""
    video = load_tower(LanguageBindVideo, preset, precision, "model", preset.revision)
    image = load_tower(CLIPModel, preset, precision, "image_model", preset.image_revision)
    with explain_unloadable("retriever", preset.model):
        tokenizer = CLIPTokenizer.from_pretrained(preset.model, revision=preset.revision)
    check_tokenizer(preset, video.config, tokenizer)
    frame_count = preset.frames
    size = {"height": preset.image_size, "width": preset.image_size}
    # The released models have no processor file. Their authors preprocess images as CLIP does.
    processor = CLIPImageProcessor(crop_size=size, size={"shortest_edge": preset.image_size})

    def embed_clips(clips: list[np.ndarray]) -> np.ndarray:
        pixels = np.concatenate([clip[spread(len(clip), frame_count)] for clip in clips])
        features = image_features(video, processor, pixels, group=frame_count)
        return unit_rows(features.reshape(len(clips), frame_count, -1).mean(axis=1))

    return DualEncoder(preset, image, video, tokenizer, processor, embed_clips)


def spread(frames: int, wanted: int) -> list[int]:
    """Return `wanted` evenly spread frame indices, repeating some if there are fewer frames."""
    return [int(k) for k in np.linspace(0, frames - 1, wanted).round()]


def load_tower(
    kind: type[CLIPModel], preset: RetrieverConfig, precision: str, key: str, revision: str | None
) -> CLIPModel:
    """Load the model that the setting `key` names; raise UserError if it is incomplete, not of this
    kind, or needs another number or size of frames than the preset's."""
    source = getattr(preset, key)
    with explain_unloadable("retriever", source, key):
        # CLIPConfig.from_pretrained would warn that the file has another model type.
        config = CLIPConfig.from_dict(CLIPConfig.get_config_dict(source, revision=revision)[0])
        is_video = getattr(config.vision_config, "add_time_attn", False)
        if is_video != (kind is LanguageBindVideo):
            raise UserError(
                f"retriever.{key}={source} is another kind of model: set retriever.model to a "
                "fully fine-tuned video model, such as LanguageBind/LanguageBind_Video_FT, and "
                "retriever.image_model to LanguageBind/LanguageBind_Image",
                code="wrong-model-type",
            )
        if is_video and (needed := config.vision_config.num_frames) != preset.frames:
            raise UserError(
                f"retriever.frames={preset.frames}, but {source} needs clips of {needed} frames: "
                f"set retriever.frames={needed}",
                code="wrong-frame-count",
            )
        check_size(preset, config)
        # The released folders have pytorch_model.bin only, from which the library loads tensors but
        # no code.
        options = {"revision": revision, "config": config, "use_safetensors": None}
        return load_complete(kind, source, precision, key, **options)
