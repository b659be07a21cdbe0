"""VLM2Vec: adapters over Qwen2-VL that make one embedding of a clip or an image and a text."""

from __future__ import annotations

from typing import Any

import torch
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer

from conf.errors import UserError
from conf.schema import RetrieverConfig
from models.checks import check_processor
from models.loading import DTYPES, UNREADABLE, check_reachable, load_error, pin_sizes
from models.retriever.embedder import PROCESSING

TEMPLATE = (
    "{%- set told = namespace(media='', texts=[]) -%}"
    "{%- for message in messages -%}"
    "{%- if message.content is string -%}{%- set told.texts = told.texts + [message.content] -%}"
    "{%- else -%}{%- for part in message.content -%}"
    "{%- if part.type == 'text' -%}{%- set told.texts = told.texts + [part.text] -%}"
    "{%- else -%}{%- set told.media = told.media + '<|' + part.type + '_pad|> ' -%}{%- endif -%}"
    "{%- endfor -%}{%- endif -%}"
    "{%- endfor -%}"
    "{{ told.media + told.texts | join(' ') }}"
)
"""As the model was trained: no roles; the medium bare, the instruction, the text."""


def load_vlm2vec(preset: RetrieverConfig, precision: str) -> SentenceTransformer:
    """The last token's state, normalised, is the embedding.

    Raises:
        UserError: the model or its base is not on this machine and cannot be fetched, is no
            Qwen2-VL, lacks a part, or has a processor of another model.
    """
    check_reachable("retriever", preset.model)
    origin = {"revision": preset.revision, "trust_remote_code": preset.trust_remote_code}
    try:
        backbone = Transformer(
            preset.model,
            model_kwargs={"dtype": DTYPES[precision], "use_safetensors": True, **origin},
            processor_kwargs=origin,
            config_kwargs=origin,
            processing_kwargs=PROCESSING,
        )
    except UNREADABLE as error:
        raise load_error("retriever", preset.model, error) from error
    config = backbone.model.config
    if config.model_type != "qwen2_vl":
        raise UserError(
            f"retriever.model={preset.model} ({config.model_type}) is no VLM2Vec over Qwen2-VL: "
            "give VLM2Vec/VLM2Vec-V2.0, or another retriever.encoder"
        )
    check_processor("retriever", preset.model, config, backbone.processor)
    pin_sizes(backbone.processor, preset.image_size, preset.frames)
    backbone.processor.chat_template = TEMPLATE
    backbone.processor.tokenizer.padding_side = "left"
    backbone.register_forward_pre_hook(flat_positions)
    pooling = Pooling(backbone.get_embedding_dimension(), pooling_mode="lasttoken")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return SentenceTransformer(modules=[backbone, pooling, Normalize()], device=device)


def flat_positions(module: Any, given: tuple[dict[str, Any]]) -> None:
    """Before the transformer, as a hook of its forward: positions count on through a medium as
    through text. A medium without its start token had no places of its own when the model was
    trained; newer versions of transformers would give it some."""
    (features,) = given
    if "mm_token_type_ids" in features:
        features["mm_token_type_ids"] = torch.zeros_like(features["mm_token_type_ids"])
