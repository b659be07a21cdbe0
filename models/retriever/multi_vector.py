"""The modules of a multi-vector retriever after its backbone.

Each scored token has a vector: the backbone's state, projected to `late.width` and normalised. The
score of a frame is the sum, over the query's vectors, of the greatest similarity to any vector of
the frame (late interaction, ColBERT's MaxSim).
"""

from __future__ import annotations

from typing import Any

import torch
from sentence_transformers import MultiVectorEncoder
from sentence_transformers.base.modules import Dense, Module, Normalize, Transformer
from torch import nn

from dynapix.conf.schema import LateConfig
from dynapix.models.retriever.scored_tokens import ScoredTokens

MESSAGE_END = "<|im_end|>"

# A saved model refers to the module by this path, and sentence-transformers finds the file in the
# model's folder.
ScoredTokens.__module__ = "scored_tokens"


def load_multi_vector(folder: str, **options: Any) -> MultiVectorEncoder:
    """Load a saved retriever with this project's `ScoredTokens`, without executing the copy of the
    class in the folder."""
    classes = {"scored_tokens.ScoredTokens": ScoredTokens}
    return MultiVectorEncoder._load_with_module_classes(folder, classes, **options)


def multi_vector_modules(backbone: Transformer, late: LateConfig) -> list[Module]:
    """Return the backbone and the modules that compute vectors from its states. The projection's
    initial weights come from a fixed seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        projection = Dense(
            backbone.get_embedding_dimension(),
            late.width,
            bias=False,
            activation_function=nn.Identity(),
            module_input_name="token_embeddings",
        )
    config = backbone.model.config
    scored = ScoredTokens(
        media_ids=[config.image_token_id, config.video_token_id],
        media_end=config.vision_end_token_id,
        message_end=backbone.tokenizer.convert_tokens_to_ids(MESSAGE_END),
    )
    return [backbone, projection, scored, Normalize("token_embeddings")]


def keep_head_fp32(model: MultiVectorEncoder) -> None:
    """Compute the projection in fp32: updates of its weights would vanish in bf16's rounding."""
    model[1].float().register_forward_pre_hook(cast_to_fp32)


def cast_to_fp32(_: nn.Module, args: tuple[dict[str, Any]]) -> None:
    """Convert the token states to fp32. This is a forward pre-hook of the projection."""
    args[0]["token_embeddings"] = args[0]["token_embeddings"].float()


def find_scored_tokens(model: MultiVectorEncoder) -> ScoredTokens:
    """Return the module of a retriever that selects the scored tokens."""
    return next(module for module in model if isinstance(module, ScoredTokens))
