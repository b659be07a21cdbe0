"""The multi-vector retriever: what differs from the one of a single vector.

Each token that is scored has a vector, the backbone's state projected to `late.width` and
normalised. A frame's score is the sum, over the query's vectors, of the most that one of the
frame's gives: late interaction, of which ColBERT's MaxSim is the form here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from sentence_transformers import MultiVectorEncoder
from sentence_transformers.base.modules import Dense, Module, Normalize, Transformer
from sentence_transformers.multi_vector_encoder.modules import HierarchicalTokenPooling
from torch import nn

from conf.schema import LateConfig
from models.retriever.scored_tokens import ScoredTokens

MESSAGE_END = "<|im_end|>"

# What is saved names a module by this, and the library then finds its file in the folder.
ScoredTokens.__module__ = "scored_tokens"
SAVED_AS = {"scored_tokens.ScoredTokens": ScoredTokens}


def multi_vector_modules(backbone: Transformer, late: LateConfig) -> list[Module]:
    """What makes vectors of the backbone's states. The projection is always drawn alike."""
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
        shown=[config.image_token_id, config.video_token_id],
        show_end=config.vision_end_token_id,
        message_end=backbone.tokenizer.convert_tokens_to_ids(MESSAGE_END),
    )
    modules = [backbone, projection, scored, Normalize("token_embeddings")]
    if late.pool > 1:
        modules.append(HierarchicalTokenPooling(late.pool, num_protected_tokens=0))
    return modules


def load_multi_vector(folder: Path, **options: Any) -> MultiVectorEncoder:
    """A saved multi-vector retriever. Its token mask is this project's, as in the library's own
    checkpoints: no code that stands in `folder` runs."""
    return MultiVectorEncoder._load_with_module_classes(str(folder), SAVED_AS, **options)


def keep_head_fp32(model: MultiVectorEncoder) -> None:
    """Keep what follows a base of lower precision in fp32: the projection, as adapters are, since
    updates of its size vanish in bf16's steps; and the distances by which tokens are pooled, which
    the library cannot read where autocast on a CPU makes them bf16."""
    model[1].float().register_forward_pre_hook(cast_to_fp32)
    for module in model:
        if isinstance(module, HierarchicalTokenPooling):
            module.pool_one = torch.autocast("cpu", enabled=False)(module.pool_one)


def cast_to_fp32(_: nn.Module, given: tuple[dict[str, Any]]) -> None:
    (features,) = given
    features["token_embeddings"] = features["token_embeddings"].float()


def find_scored_tokens(model: MultiVectorEncoder) -> ScoredTokens:
    return next(module for module in model if isinstance(module, ScoredTokens))
