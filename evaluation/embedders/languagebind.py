"""LanguageBind: a video tower and an image tower that embed into the space of one text tower.

transformers has no class for it, and its authors' code needs an older transformers. Its image and
text towers are those of CLIP. Its video tower is CLIP's image tower with attention over time before
each layer. It is implemented here with the names of the released weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn
from transformers import CLIPConfig, CLIPImageProcessor, CLIPModel, CLIPTokenizer
from transformers.models.clip.modeling_clip import CLIPAttention, CLIPEncoderLayer

from dynapix.conf.errors import UserError
from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FrameRef, sample_prefix_frames
from dynapix.models.checks import check_text_tower
from dynapix.models.loading import DTYPES, explain_unloadable, for_inference, place_weights
from dynapix.models.retriever.inputs import IMAGES, Query


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


@dataclass
class LanguageBind:
    """An `Encoder`. The embedding of a query is the sum of the unit embeddings of its prefix and
    its question, as in published baselines.

    Attributes:
        video: Embeds prefixes and texts.
        image: Embeds frames.
    """

    preset: RetrieverConfig
    video: LanguageBindVideo
    image: CLIPModel
    tokenizer: CLIPTokenizer
    processor: CLIPImageProcessor

    def embed_queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        clips = [
            frames.stack(
                q.scene_id, sample_prefix_frames(q.prefix_start, q.prefix_stop, self.preset.frames)
            )
            for q in queries
        ]
        return unit_rows(self.embed_clips(clips) + self.embed_texts([q.question for q in queries]))

    def embed_clips(self, clips: list[np.ndarray]) -> np.ndarray:
        """Embed clips, each (T, S, S, 3) uint8."""
        count = self.preset.frames
        pixels = np.concatenate([clip[spread(len(clip), count)] for clip in clips])
        features = self._features(self.video, pixels, max(1, IMAGES // count) * count)
        return unit_rows(features.reshape(len(clips), count, -1).mean(axis=1))

    def embed_frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray:
        pixels = np.stack([frames.array(f.scene_id, f.frame) for f in refs])
        return unit_rows(self._features(self.image, pixels, IMAGES))

    def embed_texts(self, texts: list[str]) -> np.ndarray:
        """Embed texts. A text is truncated to the model's maximum length, as by its authors."""
        length = self.video.config.text_config.max_position_embeddings
        inputs = self.tokenizer(
            texts, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
        )
        with torch.inference_mode():
            features = self.video.get_text_features(**inputs.to(self.video.device)).pooler_output
        return unit_rows(features.float().cpu().numpy())

    def _features(self, tower: CLIPModel, pixels: np.ndarray, batch: int) -> np.ndarray:
        """Return a tower's features (images, entries) of (images, S, S, 3) uint8 pixels."""
        features = []
        for start in range(0, len(pixels), batch):
            part = list(pixels[start : start + batch])
            inputs = self.processor(part, return_tensors="pt")["pixel_values"]
            with torch.inference_mode():
                output = tower.get_image_features(inputs.to(tower.device, tower.dtype))
            features.append(output.pooler_output.float().cpu().numpy())
        return np.concatenate(features)


def unit_rows(rows: np.ndarray) -> np.ndarray:
    """Normalise rows to length 1, in fp32."""
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def spread(frames: int, wanted: int) -> list[int]:
    """Return `wanted` evenly spread frame indices, repeating some if there are fewer frames."""
    return [int(k) for k in np.linspace(0, frames - 1, wanted).round()]


def load_languagebind(preset: RetrieverConfig, precision: str) -> LanguageBind:
    """Load the video and text towers of `model`, and the image tower of `image_model`."""
    video = load_tower(LanguageBindVideo, preset, precision, "model", preset.revision)
    image = load_tower(CLIPModel, preset, precision, "image_model", preset.image_revision)
    with explain_unloadable("retriever", preset.model):
        tokenizer = CLIPTokenizer.from_pretrained(preset.model, revision=preset.revision)
    check_text_tower(preset.model, video.config, tokenizer)
    edge = video.config.vision_config.image_size
    # The released models have no processor file. Their authors preprocess images as CLIP does.
    size = {"height": edge, "width": edge}
    processor = CLIPImageProcessor(crop_size=size, size={"shortest_edge": edge})
    return LanguageBind(preset, video, image, tokenizer, processor)


def load_tower(
    kind: type[CLIPModel], preset: RetrieverConfig, precision: str, key: str, revision: str | None
) -> CLIPModel:
    """Load the model that the setting `key` names; raise UserError if it is incomplete, not of this
    kind, or needs another number of frames than the preset's."""
    source = getattr(preset, key)
    with explain_unloadable("retriever", source, key):
        # CLIPConfig.from_pretrained would warn that the file has another model type.
        config = CLIPConfig.from_dict(CLIPConfig.get_config_dict(source, revision=revision)[0])
        vision = config.vision_config
        is_video = getattr(vision, "add_time_attn", False)
        if is_video != (kind is LanguageBindVideo):
            raise UserError(
                f"retriever.{key}={source} is another kind of model: set retriever.model to a "
                "fully fine-tuned video model, such as LanguageBind/LanguageBind_Video_FT, and "
                "retriever.image_model to LanguageBind/LanguageBind_Image",
                code="wrong-model-type",
            )
        if is_video and vision.num_frames != preset.frames:
            raise UserError(
                f"retriever.frames={preset.frames}, but {source} needs clips of "
                f"{vision.num_frames} frames: set retriever.frames={vision.num_frames}",
                code="wrong-frame-count",
            )
        # The released folders have pytorch_model.bin only, from which the library loads tensors but
        # no code.
        model, info = kind.from_pretrained(
            source, revision=revision, config=config, dtype=DTYPES[precision],
            output_loading_info=True, ignore_mismatched_sizes=True, **place_weights(),
        )  # fmt: skip
    # The library would initialise missing weights at random.
    mismatched = (name for name, *_ in info["mismatched_keys"])
    if missing := sorted({*info["missing_keys"], *mismatched}):
        raise UserError(
            f"retriever.{key}={source} lacks the weights of {len(missing)} parameters, such as "
            f"{missing[0]}: download the complete model, or set the model that the preset names",
            code="incomplete-model",
        )
    return for_inference(model)
