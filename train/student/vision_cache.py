"""The frozen vision tower's outputs, kept from the first time that a frame is shown.

The tower sees an image, or two frames of a clip that share a patch in time, by itself: what it
makes of them is the same in every sample, epoch and evaluation that shows them. They go by their
pixels, so that what is not the same is never taken for it.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import peft
import torch
from torch import nn
from transformers.models.qwen3_vl.modeling_qwen3_vl import BaseModelOutputWithDeepstackFeatures

from conf.errors import UserError
from conf.runs import local_world_size
from conf.schema import SftTrainConfig
from models.memory import available_bytes
from models.student.collator import MEDIA, Collator
from models.student.prompts import Sample

log = logging.getLogger(__name__)

KEYS = "slices"
"""Names what each slice of a batch's media shows: first those of the images, then of the clips."""


class Keyed:
    """A collator whose batches name, as `slices`, what each slice of their media shows."""

    def __init__(self, collator: Collator) -> None:
        self._collator = collator

    def __call__(self, samples: Sequence[Sample]) -> dict[str, Any]:
        return {**self._collator.named(samples), KEYS: keys_of(samples)}


def keys_of(samples: Sequence[Sample]) -> list[bytes]:
    """Of the images in order, then of the clips' pairs of frames in order."""
    # An image passes the tower as two frames that are the same; so does a clip's odd last one.
    pairs = [(image, image) for sample in samples for image in sample.images]
    for sample in samples:
        if sample.clip is not None:
            pixels = sample.clip.pixels
            last = len(pixels) - 1
            pairs += [(pixels[k], pixels[min(k + 1, last)]) for k in range(0, last + 1, 2)]
    return [_digest(*pair) for pair in pairs]


def _digest(first: np.ndarray, second: np.ndarray) -> bytes:
    told = hashlib.blake2b(repr(first.shape).encode(), digest_size=16)
    told.update(np.ascontiguousarray(first))
    told.update(np.ascontiguousarray(second))
    return told.digest()


class Features:
    """Gives a batch its tower's outputs in place of its pixels. What was made first is kept, in the
    machine's memory, up to `limit` bytes: the rest passes the tower each time."""

    def __init__(self, base: nn.Module, precision: str, limit: int) -> None:
        """`base` is the generative model, without adapters around it.

        Raises:
            UserError: its tower is trained.
        """
        if any(weight.requires_grad for weight in base.model.visual.parameters()):
            raise UserError(
                "train.reuse_features=true: the vision tower is trained here, and what it makes of "
                "a frame changes; give adapters with student.lora.rank above 0, or leave it false"
            )
        self._base = base
        self._precision = precision
        self._limit = limit
        self._kept: dict[bytes, torch.Tensor] = {}
        self.bytes = 0

    @classmethod
    def of(cls, model: nn.Module, train: SftTrainConfig) -> Features:
        """For a student, in this rank's part of half of the machine's free memory."""
        base = model.get_base_model() if isinstance(model, peft.PeftModel) else model
        return cls(
            base, train.precision, available_bytes(torch.device("cpu")) // 2 // local_world_size()
        )

    def give(self, inputs: dict[str, Any]) -> None:
        """Put a batch's outputs, as `mm_encoder_outputs`, in the place of its pixels."""
        keys = inputs.pop(KEYS)
        shown, counts = self._slices(inputs, keys)
        missing = {key: rows for key, rows in shown.items() if key not in self._kept}
        made = self._made(missing, inputs)
        device = inputs["input_ids"].device
        outputs, start = {}, 0
        for kind, count in counts.items():
            slices = [
                made[key] if key in made else self._kept[key].to(device, non_blocking=True)
                for key in keys[start : start + count]
            ]
            start += count
            merged, *deepstack = torch.cat(slices, dim=1).unbind()
            outputs[kind] = BaseModelOutputWithDeepstackFeatures(
                pooler_output=(merged,), deepstack_features=[(layer,) for layer in deepstack]
            )
        inputs["mm_encoder_outputs"] = outputs
        for key, features in made.items():
            self._keep(key, features)

    @staticmethod
    def _slices(
        inputs: dict[str, Any], keys: Sequence[bytes]
    ) -> tuple[dict[bytes, torch.Tensor], dict[str, int]]:
        """The patches of each distinct slice, and how many slices there are of each kind."""
        rows, counts = [], {}
        for kind, (name, grid) in MEDIA.items():
            if name in inputs:
                each = [
                    height * width
                    for time, height, width in inputs[grid].tolist()
                    for _ in range(time)
                ]
                rows += inputs.pop(name).split(each)
                counts[kind] = len(each)
        return dict(zip(keys, rows, strict=True)), counts

    def _made(
        self, missing: dict[bytes, torch.Tensor], inputs: dict[str, Any]
    ) -> dict[bytes, torch.Tensor]:
        """(1 + deepstack layers, tokens, hidden) of each slice that is new; all have one size."""
        if not missing:
            return {}
        height, width = next(inputs[g] for _, g in MEDIA.values() if g in inputs)[0, 1:].tolist()
        grid = torch.tensor([[1, height, width]] * len(missing))
        rows = torch.cat(list(missing.values()))
        with (
            torch.no_grad(),
            torch.autocast(rows.device.type, torch.bfloat16, enabled=self._precision == "bf16"),
        ):
            found = self._base.get_image_features(rows, grid.to(rows.device))
        layers = [found.pooler_output, *found.deepstack_features]
        return {key: torch.stack([layer[k] for layer in layers]) for k, key in enumerate(missing)}

    def _keep(self, key: bytes, features: torch.Tensor) -> None:
        size = features.nbytes
        if self.bytes + size > self._limit:
            if self.bytes <= self._limit:
                log.info("the features kept fill %.1f GiB; no more are", self.bytes / 2**30)
                self._limit = 0
            return
        self._kept[key] = features.cpu()
        self.bytes += size
