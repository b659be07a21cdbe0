"""A cache of the frozen vision tower's outputs.

The tower attends within one image, or within two frames of a clip that share a temporal patch: its
output for such a slice is the same in every sample, epoch and evaluation. The cache is keyed by the
pixels, so that no slice is mistaken for another.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import peft
import torch
from torch import nn

from conf.errors import UserError
from models.compat import encode_images, encoder_outputs
from models.distributed import is_sharded
from models.student.collator import MEDIA
from models.student.prompts import Sample

SLICES = "slices"
"""Name of a batch's slice digests: images first, then pairs of the clips' frames."""


def slice_digests(samples: Sequence[Sample]) -> list[bytes]:
    """Return a digest of each image in order, then of each pair of the clips' frames in order."""
    # The tower takes an image as two equal frames; so it does with the odd last frame of a clip.
    pairs = [(image, image) for sample in samples for image in sample.images]
    for sample in samples:
        if sample.clip is not None:
            pixels = sample.clip.pixels
            pairs += zip(pixels[::2], [*pixels[1::2], pixels[-1]], strict=False)
    digests = []
    for first, second in pairs:
        digest = hashlib.blake2b(repr(first.shape).encode(), digest_size=16)
        digest.update(np.ascontiguousarray(first))
        digest.update(np.ascontiguousarray(second))
        digests.append(digest.digest())
    return digests


class VisionCache:
    """Replaces a batch's pixels by the tower's outputs, which it keeps in the machine's memory.

    Once `limit` bytes are reached nothing more is kept: other slices pass the tower each time.

    Args:
        model: The student, with or without adapters.
        precision: bf16 or fp32.
        limit: In bytes.

    Raises:
        UserError: the vision tower is trained, or sharded over ranks.
    """

    def __init__(self, model: nn.Module, precision: str, limit: int) -> None:
        base = model.get_base_model() if isinstance(model, peft.PeftModel) else model
        if any(weight.requires_grad for weight in base.model.visual.parameters()):
            raise UserError(
                "train.reuse_features=true needs a frozen vision tower, and this one is trained: "
                "set student.lora.rank above 0, or train.reuse_features=false",
                code="vision-tower-trained",
            )
        if is_sharded():
            raise UserError(
                "train.reuse_features=true does not work with FSDP, which leaves no rank a whole "
                "vision tower: set it to false, or start without --use_fsdp",
                code="unsupported-with-fsdp",
            )
        self._base = base
        self._precision = precision
        self._limit = limit
        self._kept: dict[bytes, torch.Tensor] = {}
        self.bytes = 0

    def replace_pixels(self, inputs: dict[str, Any]) -> None:
        """Put the tower's outputs, as `mm_encoder_outputs`, in the place of a batch's pixels."""
        digests, patches, counts = inputs.pop(SLICES), [], {}
        for kind, (name, grid) in MEDIA.items():
            if name in inputs:
                sizes = [h * w for time, h, w in inputs[grid].tolist() for _ in range(time)]
                patches += inputs.pop(name).split(sizes)
                counts[kind] = len(sizes)
        slices = dict(zip(digests, patches, strict=True))
        new = self._encode({k: v for k, v in slices.items() if k not in self._kept}, inputs)
        device = inputs["input_ids"].device
        outputs, start = {}, 0
        for kind, count in counts.items():
            features = [
                new[key] if key in new else self._kept[key].to(device, non_blocking=True)
                for key in digests[start : start + count]
            ]
            start += count
            outputs[kind] = encoder_outputs(torch.cat(features, dim=1))
        inputs["mm_encoder_outputs"] = outputs
        for key, features in new.items():
            if self.bytes + features.nbytes <= self._limit:
                self._kept[key] = features.cpu()
                self.bytes += features.nbytes

    def _encode(
        self, slices: dict[bytes, torch.Tensor], inputs: dict[str, Any]
    ) -> dict[bytes, torch.Tensor]:
        """Return (1 + deepstack layers, tokens, hidden) for each slice; all have one size."""
        if not slices:
            return {}
        height, width = next(inputs[g] for _, g in MEDIA.values() if g in inputs)[0, 1:].tolist()
        patches = torch.cat(list(slices.values()))
        grid = torch.tensor([[1, height, width]] * len(slices), device=patches.device)
        encoded = encode_images(self._base, patches, grid, self._precision == "bf16")
        return dict(zip(slices, encoded, strict=True))
