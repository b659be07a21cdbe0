"""VLM2Vec: Qwen2-VL with adapters, which embeds a clip or an image together with a text."""

from __future__ import annotations

from typing import Any

import torch
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer

from dynapix.conf.errors import UserError
from dynapix.conf.schema import RetrieverConfig
from dynapix.models.checks import check_processor
from dynapix.models.distributed import rank_device
from dynapix.models.loading import DTYPES, explain_unloadable, pin_sizes, place_weights
from dynapix.models.retriever.embedder import PROCESSING

TEMPLATE = (
    "{%- set parts = namespace(media='', texts=[]) -%}"
    "{%- for message in messages -%}"
    "{%- if message.content is string -%}{%- set parts.texts = parts.texts + [message.content] -%}"
    "{%- else -%}{%- for part in message.content -%}"
    "{%- if part.type == 'text' -%}{%- set parts.texts = parts.texts + [part.text] -%}"
    "{%- else -%}{%- set parts.media = parts.media + '<|' + part.type + '_pad|> ' -%}{%- endif -%}"
    "{%- endfor -%}{%- endif -%}"
    "{%- endfor -%}"
    "{{ parts.media + parts.texts | join(' ') }}"
)
"""Chat template in the format that VLM2Vec was trained with: the placeholder token of the image or
video, the instruction and the text, without roles and without start and end tokens."""


def load_vlm2vec(preset: RetrieverConfig, precision: str) -> SentenceTransformer:
    """Load VLM2Vec. Its embedding is the last hidden state of the last token, L2-normalised."""
    origin = {"revision": preset.revision, "trust_remote_code": preset.trust_remote_code}
    with explain_unloadable("retriever", preset.model):
        backbone = Transformer(
            preset.model,
            model_kwargs={
                "dtype": DTYPES[precision],
                "use_safetensors": True,
                **origin,
                **place_weights(),
            },
            processor_kwargs=origin,
            config_kwargs=origin,
            processing_kwargs=PROCESSING,
        )
    config = backbone.model.config
    if config.model_type != "qwen2_vl":
        raise UserError(
            f"retriever.model={preset.model} ({config.model_type}) is not a VLM2Vec over Qwen2-VL: "
            "set retriever.model=VLM2Vec/VLM2Vec-V2.0, or another retriever.encoder",
            code="wrong-model-type",
        )
    check_processor("retriever", preset.model, config, backbone.processor)
    pin_sizes(backbone.processor, preset.image_size, preset.frames)
    backbone.processor.chat_template = TEMPLATE
    backbone.processor.tokenizer.padding_side = "left"
    backbone.register_forward_pre_hook(use_text_positions)
    pooling = Pooling(backbone.get_embedding_dimension(), pooling_mode="lasttoken")
    prompts = {"query": preset.query_instruction, "document": preset.frame_instruction}
    modules = [backbone, pooling, Normalize()]
    return SentenceTransformer(modules=modules, device=str(rank_device()), prompts=prompts)


def use_text_positions(module: Any, args: tuple[dict[str, Any]]) -> None:
    """Forward pre-hook that gives the tokens of images and videos sequential positions, like the
    tokens of text.

    VLM2Vec was trained without vision start tokens, and therefore without spatial positions. Newer
    versions of transformers assign spatial positions even without these tokens.
    """
    (features,) = args
    if "mm_token_type_ids" in features:
        features["mm_token_type_ids"] = torch.zeros_like(features["mm_token_type_ids"])
