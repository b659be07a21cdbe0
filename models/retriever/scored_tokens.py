"""Which tokens of a multi-vector retriever are scored.

This file is written beside every model that it is a part of, and needs sentence-transformers alone:
`MultiVectorEncoder(FOLDER, trust_remote_code=True)` loads such a model without this project.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, ClassVar

import torch
from sentence_transformers.base.modules import Module


class ScoredTokens(Module):
    """Leaves in `attention_mask` the tokens that are scored: those of images and clips, and those
    that follow the last of them, up to the end of the message. Neither the instruction nor the
    template's own tokens nor a clip's timestamps are.

    The library's `MultiVectorMask` tells tokens by their ids, and a question's words and digits
    have those of the instruction and of the timestamps.
    """

    config_keys: ClassVar[list[str]] = ["shown", "show_end", "message_end"]

    def __init__(self, shown: list[int], show_end: int, message_end: int) -> None:
        """`shown`: ids that stand for what an image or a clip shows; `show_end` closes these,
        `message_end` a message."""
        super().__init__()
        self.shown = list(shown)
        self.show_end, self.message_end = show_end, message_end

    def forward(self, features: dict[str, Any], **_: Any) -> dict[str, Any]:
        features["attention_mask"] = self.scored(features["input_ids"], features["attention_mask"])
        return features

    def scored(self, ids: torch.Tensor, attended: torch.Tensor) -> torch.Tensor:
        """(B, L) which tokens of these ids, (B, L), are scored; those that pad are not attended.

        Raises:
            ValueError: a row shows nothing.
        """
        ends = ids == self.show_end
        if not ends.any(dim=1).all():
            raise ValueError("an input shows neither an image nor a clip: only such are scored")
        said = ends.flip(1).cumsum(dim=1).flip(1) == 0
        said &= (said & (ids == self.message_end)).cumsum(dim=1) == 0
        shown = torch.isin(ids, torch.tensor(self.shown, device=ids.device))
        return attended.bool() & (shown | said)

    def save(self, output_path: str, *args: Any, **kwargs: Any) -> None:
        self.save_config(output_path)
        # The library looks for a module's own code in the model's folder.
        shutil.copy(__file__, Path(output_path).parent)
