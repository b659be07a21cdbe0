"""Dual encoders, such as CLIP and SigLIP 2: separate towers embed images and texts in one space.

They cannot embed a clip together with a question. A query is embedded as in published baselines:
the embedding of a prefix is the mean of the unit embeddings of its frames, and the embedding of a
query is the sum of the embeddings of its prefix and its question. Each result is normalised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from transformers import AutoConfig, AutoModel, AutoProcessor, PreTrainedModel

from dynapix.conf.errors import UserError
from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FrameRef, sample_prefix_frames
from dynapix.models.loading import DTYPES, explain_unloadable, for_inference, place_weights
from dynapix.models.retriever.inputs import Query

EmbedClips = Callable[[list[np.ndarray]], np.ndarray]

MODEL_TYPES = ("clip", "metaclip_2", "siglip", "siglip2")
"""Supported model types, as transformers names them."""
BATCH = 64
"""Maximum number of images that a tower embeds together."""


@dataclass
class DualEncoder:
    """An `Encoder` with an image tower and a text tower.

    Attributes:
        image_tower: Model of transformers that embeds images with `get_image_features`.
        text_tower: Model of transformers that embeds texts with `get_text_features`.
        embed_clips: Returns unit embeddings (clips, entries) of clips, each (T, S, S, 3) uint8.
            None takes the mean of the embeddings of a clip's frames.
    """

    preset: RetrieverConfig
    image_tower: PreTrainedModel
    text_tower: PreTrainedModel
    tokenizer: Any
    image_processor: Any
    embed_clips: EmbedClips | None = None

    def embed_queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        clips = [
            frames.stack(
                q.scene_id, sample_prefix_frames(q.prefix_start, q.prefix_stop, self.preset.frames)
            )
            for q in queries
        ]
        prefixes = self.embed_clips(clips) if self.embed_clips else self._embed_means(clips)
        return unit_rows(prefixes + self.embed_texts([q.question for q in queries]))

    def embed_frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray:
        return self._embed_images(np.stack([frames.array(f.scene_id, f.frame) for f in refs]))

    def embed_texts(self, texts: list[str]) -> np.ndarray:
        """Embed texts. A text is truncated to the model's maximum length, as by its authors."""
        inputs = self.tokenizer(
            # SigLIP 2 was trained on text in lower case. CLIP's tokenizer converts text itself.
            [text.lower() for text in texts],
            padding="max_length",
            max_length=self.text_tower.config.text_config.max_position_embeddings,
            truncation=True,
            return_tensors="pt",
        )
        fields = {name: value.to(self.text_tower.device) for name, value in inputs.items()}
        # SigLIP was trained without an attention mask: it attends to the padding.
        if self.text_tower.config.model_type.startswith("siglip"):
            fields = {"input_ids": fields["input_ids"]}
        with torch.inference_mode():
            features = self.text_tower.get_text_features(**fields).pooler_output
        return unit_rows(features.float().cpu().numpy())

    def _embed_means(self, clips: list[np.ndarray]) -> np.ndarray:
        ends = np.cumsum([len(clip) for clip in clips])[:-1]
        frames_of_clips = np.split(self._embed_images(np.concatenate(clips)), ends)
        return unit_rows(np.stack([frames.mean(axis=0) for frames in frames_of_clips]))

    def _embed_images(self, pixels: np.ndarray) -> np.ndarray:
        """Embed (images, S, S, 3) uint8 pixels."""
        return unit_rows(image_features(self.image_tower, self.image_processor, pixels))


def image_features(
    tower: PreTrainedModel, image_processor: Any, pixels: np.ndarray, group: int = 1
) -> np.ndarray:
    """Return a tower's features (images, entries) of images.

    Args:
        pixels: (images, S, S, 3) uint8, where S is the tower's image size.
        group: Number of consecutive images that must be in one batch, such as a clip's frames.
    """
    # For a tower without a fixed image size, the processor resizes images to whole patches.
    any_size = hasattr(image_processor, "max_num_patches")
    sizes = {} if any_size else {"do_resize": False, "do_center_crop": False}
    inputs = image_processor(list(pixels), return_tensors="pt", **sizes)
    step = max(1, BATCH // group) * group
    features = []
    for start in range(0, len(pixels), step):
        batch = {}
        for name, value in inputs.items():
            dtype = tower.dtype if value.is_floating_point() else None
            batch[name] = value[start : start + step].to(tower.device, dtype)
        with torch.inference_mode():
            features.append(tower.get_image_features(**batch).pooler_output.float().cpu().numpy())
    return np.concatenate(features)


def unit_rows(rows: np.ndarray) -> np.ndarray:
    """Normalise rows to length 1, in fp32. A row of zeros stays unchanged."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return (rows / np.where(lengths > 0, lengths, 1)).astype(np.float32)


def load_dual(preset: RetrieverConfig, precision: str) -> DualEncoder:
    """Load a model of one of `MODEL_TYPES`."""
    origin = {"revision": preset.revision, "trust_remote_code": preset.trust_remote_code}
    with explain_unloadable("retriever", preset.model):
        config = AutoConfig.from_pretrained(preset.model, **origin)
        if config.model_type not in MODEL_TYPES:
            raise UserError(
                f"retriever.model={preset.model} ({config.model_type}) is neither CLIP nor SigLIP: "
                "choose one of these, or another retriever.encoder",
                code="wrong-model-type",
            )
        processor = AutoProcessor.from_pretrained(preset.model, **origin)
        model = load_complete(AutoModel, preset.model, precision, **origin)
    if missing := [x for x in ("image_processor", "tokenizer") if not hasattr(processor, x)]:
        raise UserError(
            f"retriever.model={preset.model} lacks its {missing[0].replace('_', ' ')}: add the "
            "files that were released with the weights",
            code="incomplete-model",
        )
    check_tokenizer(preset, config, processor.tokenizer)
    check_size(preset, config)
    return DualEncoder(preset, model, model, processor.tokenizer, processor.image_processor)


def load_complete(
    kind: Any, source: str, precision: str, key: str = "model", **options: Any
) -> PreTrainedModel:
    """Load a model from safetensors, unless `options` say otherwise, onto a GPU if there is one.
    Raise UserError if weights are missing, since the library would initialise them at random."""
    model, loading_info = kind.from_pretrained(
        source,
        dtype=DTYPES[precision],
        output_loading_info=True,
        ignore_mismatched_sizes=True,
        **{"use_safetensors": True, **place_weights(), **options},
    )
    mismatched = (name for name, *_ in loading_info["mismatched_keys"])
    if missing := sorted({*loading_info["missing_keys"], *mismatched}):
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise UserError(
            f"retriever.{key}={source} lacks the weights {missing[0]}{more}: download the complete "
            "model, or set the model that the preset names",
            code="incomplete-model",
        )
    return for_inference(model)


def check_tokenizer(preset: RetrieverConfig, config: Any, tokenizer: Any) -> None:
    """Raise UserError if a tokenizer does not fit the model's vocabulary.

    The library builds an almost empty tokenizer if the files are missing. A vocabulary that is
    larger than the tokenizer is accepted up to a factor of 2, since models pad it.
    """
    tokens, vocabulary = len(tokenizer), config.text_config.vocab_size
    if not vocabulary / 2 < tokens <= vocabulary:
        raise UserError(
            f"retriever.model={preset.model} has a tokenizer of {tokens} tokens for a vocabulary "
            f"of {vocabulary}: add the tokenizer's files that were released with the weights",
            code="incomplete-model",
        )


def check_size(preset: RetrieverConfig, config: Any) -> None:
    """Raise UserError if a model needs images of another size than the preset's."""
    size = getattr(config.vision_config, "image_size", None)
    if size is not None and size != preset.image_size:
        raise UserError(
            f"retriever.image_size={preset.image_size}, but {preset.model} needs images of {size} "
            f"x {size} px: set retriever.image_size={size}",
            code="wrong-image-size",
        )
