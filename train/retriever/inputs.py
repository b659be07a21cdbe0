"""Build the inputs of a retriever's forward pass from queries and frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import torch
from accelerate.utils import send_to_device

from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.models.compat import encode_images, encoder_outputs
from dynapix.models.retriever.inputs import QueryOrFrame, Retriever, model_inputs, preprocess
from dynapix.models.student.collator import MEDIA

log = logging.getLogger(__name__)

FEATURES = "vision_features"
"""Prefix of the inputs that hold outputs of the vision tower, such as vision_features_image."""


class RetrieverInputs:
    """Loads the inputs of one mini-batch at a time.

    Args:
        model: The retriever. Its backbone gets the hook `pass_features`.
        frames: Reads the pixels of the benchmark's frames.
        cfg: The retriever's preset, with its instructions and the number of frames of a prefix.
        bf16: Whether the vision tower computes in bf16.
        reuse_features: Whether to compute the outputs of the frozen vision tower in the first pass
            of a step only, and to keep them for the second pass, if there is one. Only Qwen3-VL
            takes such outputs; other models compute them again.
    """

    def __init__(
        self,
        model: Retriever,
        frames: FrameReader,
        cfg: RetrieverConfig,
        bf16: bool,
        reuse_features: bool = False,
    ) -> None:
        self._model, self._frames, self._cfg = model, frames, cfg
        takes_features = model[0].config.model_type == "qwen3_vl"
        self._bf16, self._reuse = bf16, reuse_features and takes_features
        if reuse_features and not takes_features:
            log.info("train.reuse_features has no effect: %s takes pixels only", cfg.name)
        self._kept: dict[tuple[QueryOrFrame, ...], dict[str, Any]] = {}
        model[0].register_forward_pre_hook(pass_features)

    def load(self, items: Sequence[QueryOrFrame]) -> dict[str, Any]:
        """Return the inputs of queries or of frames, on the CPU."""
        kept = self._kept.pop(tuple(items), None)
        if kept is not None:
            return kept
        return preprocess(self._model, *model_inputs(self._model, items, self._frames, self._cfg))

    def prepare(
        self, items: Sequence[QueryOrFrame], inputs: dict[str, Any], is_first_of_two: bool
    ) -> dict[str, Any]:
        """Move loaded inputs to the model's device. In the first of two passes with
        `reuse_features`, also replace the pixels by the vision tower's outputs, and keep the
        result, which the next `load` of the same items returns."""
        inputs = send_to_device(inputs, self._model.device, non_blocking=True)
        if is_first_of_two and self._reuse:
            inputs = self._encode_media(inputs)
            self._kept[tuple(items)] = send_to_device(inputs, "cpu")
        return inputs

    def _encode_media(self, inputs: dict[str, Any]) -> dict[str, Any]:
        """Return inputs in which the vision tower's outputs replace the pixels."""
        encoded = dict(inputs)
        for kind, (pixels, grid) in MEDIA.items():
            if pixels in encoded:
                images = encode_images(
                    self._model[0].model, encoded.pop(pixels), encoded[grid], self._bf16
                )
                encoded[f"{FEATURES}_{kind}"] = torch.cat(images, dim=1)
        return encoded


def pass_features(module: Any, args: tuple[dict[str, Any]]) -> None:
    """Forward pre-hook of a backbone: rename kept outputs of the vision tower to the input in which
    Qwen3-VL takes them instead of pixels."""
    (inputs,) = args
    kept = {kind: inputs.pop(f"{FEATURES}_{kind}", None) for kind in MEDIA}
    if outputs := {k: encoder_outputs(layers) for k, layers in kept.items() if layers is not None}:
        inputs["mm_encoder_outputs"] = outputs
