"""Select the tokens whose vectors a multi-vector retriever compares (the scored tokens).

This file is copied into the folder of every model that uses it, and needs only
sentence-transformers: `MultiVectorEncoder(FOLDER, trust_remote_code=True)` loads the model.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, ClassVar

import torch
from sentence_transformers.base.modules import Module


class ScoredTokens(Module):
    """Reduces `attention_mask` to the scored tokens: those of images and clips, and those from the
    end of the last image or clip to the end of its message. The instruction, the template's tokens
    and a clip's timestamps are not scored.

    Sentence-transformers' `MultiVectorMask` selects tokens by id, and thus cannot distinguish the
    words and digits of a question from those of the instruction and the timestamps.

    Args:
        media_ids: Ids of the placeholder tokens of pixels.
        media_end: Id of the token that closes an image or a clip.
        message_end: Id of the token that closes a message.
    """

    config_keys: ClassVar[list[str]] = ["media_ids", "media_end", "message_end"]

    def __init__(self, media_ids: list[int], media_end: int, message_end: int) -> None:
        super().__init__()
        self.media_ids = list(media_ids)
        self.media_end, self.message_end = media_end, message_end

    def forward(self, features: dict[str, Any], **_: Any) -> dict[str, Any]:
        features["attention_mask"] = self.scored(features["input_ids"], features["attention_mask"])
        return features

    def scored(self, ids: torch.Tensor, attended: torch.Tensor) -> torch.Tensor:
        """Return a (B, L) mask of the scored tokens of `ids`, (B, L); `attended` is 0 for padding.

        Raises:
            ValueError: A row has neither an image nor a clip.
        """
        ends = ids == self.media_end
        if not ends.any(dim=1).all():
            raise ValueError("an input has neither an image nor a clip, so it cannot be scored")
        text = ends.flip(1).cumsum(dim=1).flip(1) == 0
        text &= (text & (ids == self.message_end)).cumsum(dim=1) == 0
        media = torch.isin(ids, torch.tensor(self.media_ids, device=ids.device))
        return attended.bool() & (media | text)

    def save(self, output_path: str, *args: Any, **kwargs: Any) -> None:
        self.save_config(output_path)
        # Sentence-transformers looks for the code of a module in the model's folder.
        shutil.copy(__file__, Path(output_path).parent)
