"""A cache of the frozen vision tower's outputs.

The tower encodes each pair of frames separately. A pair is two consecutive frames of a clip, or the
same image twice. Its output is therefore the same in every sample, epoch and evaluation, and can be
cached under a digest of the pair's pixels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import peft
import torch
from torch import nn

from dynapix.conf.errors import UserError
from dynapix.models.compat import encode_images, encoder_outputs
from dynapix.models.distributed import is_sharded
from dynapix.models.student.collator import MEDIA
from dynapix.models.student.prompts import Sample

PAIRS = "frame_pairs"
"""Name of the digests of a batch's frame pairs: those of its images, then those of its clips."""


def pair_digests(samples: Sequence[Sample]) -> list[bytes]:
    """Return a digest of each image, then of each pair of frames of each clip."""
    pairs = [(image, image) for sample in samples for image in sample.images]
    for sample in samples:
        if sample.clip is not None:
            pixels = sample.clip.pixels
            # If the number of frames is odd, the last frame forms a pair with itself.
            pairs += zip(pixels[::2], [*pixels[1::2], pixels[-1]], strict=False)
    digests = []
    for first, second in pairs:
        digest = hashlib.blake2b(repr(first.shape).encode(), digest_size=16)
        digest.update(np.ascontiguousarray(first))
        digest.update(np.ascontiguousarray(second))
        digests.append(digest.digest())
    return digests


class VisionCache:
    """Replaces the pixels of batches by the tower's outputs, which it keeps in the CPU's memory.

    An output that would exceed the limit is not kept; the tower encodes its pair each time.

    Args:
        model: The student, with or without adapters.
        precision: bf16 or fp32, in which the tower computes.
        limit: Maximum size of the kept outputs in bytes.

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
                "train.reuse_features=true does not work with FSDP, since no rank has all weights "
                "of the vision tower: set it to false, or start without --use_fsdp",
                code="unsupported-with-fsdp",
            )
        self._base = base
        self._precision = precision
        self._limit = limit
        self._kept: dict[bytes, torch.Tensor] = {}
        self.bytes = 0

    def encode_media(self, inputs: dict[str, Any]) -> None:
        """Replace a batch's pixels and digests by the tower's outputs, `mm_encoder_outputs`."""
        digests, size = inputs.pop(PAIRS), []
        keys: dict[str, list[bytes]] = {}
        pixels: dict[bytes, torch.Tensor] = {}
        for kind, (name, grid) in MEDIA.items():
            if name in inputs:
                size = inputs[grid][0, 1:].tolist()
                pairs = inputs.pop(name).chunk(int(inputs[grid][:, 0].sum()))
                keys[kind], digests = digests[: len(pairs)], digests[len(pairs) :]
                pixels.update(zip(keys[kind], pairs, strict=True))
        new = self._encode({k: v for k, v in pixels.items() if k not in self._kept}, size)
        device = inputs["input_ids"].device
        inputs["mm_encoder_outputs"] = {
            kind: encoder_outputs(
                torch.cat([new[k] if k in new else self._kept[k].to(device) for k in pairs], dim=1)
            )
            for kind, pairs in keys.items()
        }
        for key, features in new.items():
            if self.bytes + features.nbytes <= self._limit:
                self._kept[key] = features.cpu()
                self.bytes += features.nbytes

    def _encode(
        self, pixels: dict[bytes, torch.Tensor], size: list[int]
    ) -> dict[bytes, torch.Tensor]:
        """Return the output (1 + deepstack layers, tokens, hidden) for each pair. All pairs have
        `size` patches in height and width."""
        if not pixels:
            return {}
        patches = torch.cat(list(pixels.values()))
        grid = torch.tensor([[1, *size]] * len(pixels), device=patches.device)
        encoded = encode_images(self._base, patches, grid, self._precision == "bf16")
        return dict(zip(pixels, encoded, strict=True))
