"""Build the inputs of a retriever's forward pass from queries and frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from accelerate.utils import send_to_device

from conf.schema import RetrieverConfig
from data.render.frame_cache import FrameReader
from models.compat import encode_images, encoder_outputs
from models.retriever.embedder import Item, Retriever, model_inputs
from models.student.collator import MEDIA

FEATURES = "vision_features"
"""Prefix, before a kind of media, of the vision tower's outputs among a model's inputs."""


class RetrieverInputs:
    """Loads the inputs of one mini-batch at a time, so that memory is independent of the batch.

    Args:
        model: The retriever; its backbone gets a hook that accepts outputs of its vision tower.
        frames: Pixels of the benchmark's frames.
        cfg: The retriever's preset: its instructions and the frames of a prefix.
        bf16: Whether the vision tower computes in bf16.
        reuse_features: Whether the frozen vision tower's outputs of a step's first pass are kept
            for its second pass.
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
        self._bf16, self._reuse = bf16, reuse_features
        self._kept: dict[tuple[Item, ...], dict[str, Any]] = {}
        model[0].register_forward_pre_hook(pass_features)

    def load(self, items: Sequence[Item]) -> dict[str, Any]:
        """Return the inputs of queries, or of frames, on the CPU."""
        kept = self._kept.pop(tuple(items), None)
        if kept is not None:
            return kept
        inputs, instruction = model_inputs(items, self._frames, self._cfg)
        return self._model.preprocess(inputs, prompt=instruction)

    def prepare(
        self, items: Sequence[Item], inputs: dict[str, Any], first_pass: bool
    ) -> dict[str, Any]:
        """Move loaded inputs to the model's device. In a first pass with `reuse_features`, also
        replace the pixels by the vision tower's outputs, which the next `load` of these items
        returns."""
        inputs = send_to_device(inputs, self._model.device, non_blocking=True)
        if first_pass and self._reuse:
            inputs = self._encode_media(inputs)
            self._kept[tuple(items)] = send_to_device(inputs, "cpu")
        return inputs

    def _encode_media(self, inputs: dict[str, Any]) -> dict[str, Any]:
        encoded = dict(inputs)
        for kind, (pixels, grid) in MEDIA.items():
            if pixels in encoded:
                images = encode_images(
                    self._model[0].model, encoded.pop(pixels), encoded[grid], self._bf16
                )
                encoded[f"{FEATURES}_{kind}"] = torch.cat(images, dim=1)
        return encoded


def pass_features(module: Any, args: tuple[dict[str, Any]]) -> None:
    """Pass kept outputs of the vision tower to the backbone, under the name that its `forward`
    has for them. This is a hook that is called before that `forward`."""
    (inputs,) = args
    kept = {kind: inputs.pop(f"{FEATURES}_{kind}", None) for kind in MEDIA}
    if outputs := {k: encoder_outputs(layers) for k, layers in kept.items() if layers is not None}:
        inputs["mm_encoder_outputs"] = outputs
