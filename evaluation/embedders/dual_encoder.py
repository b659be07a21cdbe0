"""Dual encoders, CLIP and SigLIP 2: frames and texts are embedded apart, in one space.

They have no way to read a clip together with a question, so a query is put together as published
baselines of such models are: a prefix is the mean of its frames' unit embeddings, again of unit
length, and a query is the sum of its prefix's and its question's embeddings, both weighing alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from transformers import AutoConfig, AutoModel, AutoProcessor, PreTrainedModel

from conf.errors import UserError
from conf.schema import RetrieverConfig
from data.records import FrameRef, sample_prefix_frames
from data.render.frame_cache import FrameReader
from evaluation.embedders.base import Query
from models.loading import DTYPES, UNREADABLE, check_reachable, load_error

Clips = Callable[[list[np.ndarray]], np.ndarray]

DUAL = ("clip", "metaclip_2", "siglip", "siglip2")
"""Types of models that are read here, as transformers names them."""
IMAGES = 64
"""Images that pass a tower at once."""


@dataclass
class DualEncoder:
    """Embeds by towers of transformers' own classes.

    Attributes:
        images: embeds images, by `get_image_features`.
        language: embeds texts, by `get_text_features`; for CLIP the same model.
        watch: makes unit embeddings of clips, (T, S, S, 3) uint8 each; None takes the mean of their
            frames'.
    """

    preset: RetrieverConfig
    images: PreTrainedModel
    language: PreTrainedModel
    tokenizer: Any
    image_processor: Any
    watch: Clips | None = None

    def queries(self, asked: list[Query], frames: FrameReader) -> np.ndarray:
        clips = [
            frames.stack(
                q.scene_id, sample_prefix_frames(q.prefix_start, q.prefix_stop, self.preset.frames)
            )
            for q in asked
        ]
        prefixes = self.watch(clips) if self.watch else self._means(clips)
        return unit_rows(prefixes + self.texts([q.question for q in asked]))

    def frames(self, shown: list[FrameRef], frames: FrameReader) -> np.ndarray:
        return self.drawn([frames.array(f.scene_id, f.frame) for f in shown])

    def drawn(self, shown: list[np.ndarray]) -> np.ndarray:
        return self._seen(np.stack(shown))

    def texts(self, texts: list[str]) -> np.ndarray:
        """A text that is longer than the model reads is cut, as its authors do."""
        inputs = self.tokenizer(
            # SigLIP 2 was trained on lower case; CLIP's tokenizer knows no other.
            [text.lower() for text in texts],
            padding="max_length",
            max_length=self.language.config.text_config.max_position_embeddings,
            truncation=True,
            return_tensors="pt",
        )
        given = {name: value.to(self.language.device) for name, value in inputs.items()}
        # SigLIP was trained to look at its padding.
        if self.language.config.model_type.startswith("siglip"):
            given = {"input_ids": given["input_ids"]}
        with torch.inference_mode():
            return unit_rows(as_array(self.language.get_text_features(**given).pooler_output))

    def _means(self, clips: list[np.ndarray]) -> np.ndarray:
        ends = np.cumsum([len(clip) for clip in clips])[:-1]
        each = np.split(self._seen(np.concatenate(clips)), ends)
        return unit_rows(np.stack([embeddings.mean(axis=0) for embeddings in each]))

    def _seen(self, pixels: np.ndarray) -> np.ndarray:
        """Of (images, S, S, 3) uint8."""
        shown = pixel_values(self.image_processor, pixels)
        with torch.inference_mode():
            return unit_rows(
                np.concatenate(
                    [
                        as_array(self.images.get_image_features(**part).pooler_output)
                        for part in at_once(shown, self.images)
                    ]
                )
            )


def pixel_values(image_processor: Any, pixels: np.ndarray) -> dict[str, torch.Tensor]:
    """What a tower takes of (images, S, S, 3) uint8, which have its size already."""
    # A tower that takes any size has it cut into patches by its processor's own resizing.
    any_size = hasattr(image_processor, "max_num_patches")
    sizes = {} if any_size else {"do_resize": False, "do_center_crop": False}
    return dict(image_processor(list(pixels), return_tensors="pt", **sizes))


def at_once(
    shown: dict[str, torch.Tensor], model: PreTrainedModel, together: int = 1
) -> Iterator[dict[str, torch.Tensor]]:
    """A tower's input in parts, on its device, in its precision; `together` images go together."""
    count, step = len(shown["pixel_values"]), max(1, IMAGES // together) * together
    for start in range(0, count, step):
        part = {name: value[start : start + step] for name, value in shown.items()}
        yield {
            name: value.to(model.device, model.dtype if value.is_floating_point() else None)
            for name, value in part.items()
        }


def unit_rows(rows: np.ndarray) -> np.ndarray:
    """Rows of length 1, fp32; a row of zeros stays."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return (rows / np.where(lengths > 0, lengths, 1)).astype(np.float32)


def as_array(found: torch.Tensor) -> np.ndarray:
    return found.float().cpu().numpy()


def load_dual(preset: RetrieverConfig, precision: str) -> DualEncoder:
    """A model of one of the types in `DUAL`.

    Raises:
        UserError: it is not on this machine and cannot be fetched, is no such model, lacks a part,
            or takes frames of another size.
    """
    check_reachable("retriever", preset.model)
    origin = {"revision": preset.revision, "trust_remote_code": preset.trust_remote_code}
    try:
        config = AutoConfig.from_pretrained(preset.model, **origin)
        if config.model_type not in DUAL:
            raise UserError(
                f"retriever.model={preset.model} ({config.model_type}) is no CLIP and no SigLIP, "
                "which embed frames and texts apart in one space: give one of these, or another "
                "retriever.encoder"
            )
        processor = AutoProcessor.from_pretrained(preset.model, **origin)
        model = whole(AutoModel, preset.model, precision, "model", **origin)
    except UNREADABLE as error:
        raise load_error("retriever", preset.model, error) from error
    for part in ("image_processor", "tokenizer"):
        if not hasattr(processor, part):
            raise UserError(
                f"retriever.model={preset.model} lacks its {part.replace('_', ' ')}: put the files "
                "there that came with the weights"
            )
    check_words(preset, config, processor.tokenizer)
    check_size(preset, config)
    return DualEncoder(preset, model, model, processor.tokenizer, processor.image_processor)


def whole(kind: Any, source: str, precision: str, key: str, **options: Any) -> PreTrainedModel:
    """A model of safetensors, on the card where there is one.

    Raises:
        UserError: the file lacks weights, which the library would draw by chance.
    """
    model, told = kind.from_pretrained(
        source,
        dtype=DTYPES[precision],
        use_safetensors=True,
        output_loading_info=True,
        ignore_mismatched_sizes=True,
        **options,
    )
    misfits = (key for key, *_ in told["mismatched_keys"])
    if lacking := sorted({*told["missing_keys"], *misfits}):
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        raise UserError(
            f"retriever.{key}={source} lacks the weights {lacking[0]}{more}: fetch the whole "
            "model, or give the one that the preset names"
        )
    return model.eval().to("cuda" if torch.cuda.is_available() else "cpu")


def check_words(preset: RetrieverConfig, config: Any, tokenizer: Any) -> None:
    """Raises UserError where a tokenizer is not the model's: without its files the library makes
    one that knows no words. A model's vocabulary may be filled up with some that nobody uses."""
    there, known = len(tokenizer), config.text_config.vocab_size
    if not known / 2 < there <= known:
        raise UserError(
            f"retriever.model={preset.model} has a tokenizer of {there} tokens, and the model "
            f"knows {known}: put the tokenizer's files there that came with the weights"
        )


def check_size(preset: RetrieverConfig, config: Any) -> None:
    """Raises UserError where the model's tower takes images of another size than frames have."""
    size = getattr(config.vision_config, "image_size", None)
    if size is not None and size != preset.image_size:
        raise UserError(
            f"retriever.image_size={preset.image_size}, and {preset.model} takes images of {size} "
            f"x {size} px: give retriever.image_size={size}"
        )
