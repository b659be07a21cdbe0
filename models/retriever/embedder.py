"""Load retrievers with sentence-transformers.

Any model that the library loads can be a retriever; `models.retriever.inputs` gives it its inputs.
A saved retriever keeps its modules and its prompts. Another model takes its inputs in the form of
Qwen3-VL-Embedding's: the prompt is the system message, the query or the frame is the user message,
and a generation prompt follows. The embedding is the normalised hidden state of the last token, or
one vector per token (`models.retriever.multi_vector`). Trained retrievers are saved as plain
`SentenceTransformer` or `MultiVectorEncoder` models.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from sentence_transformers.util import is_sentence_transformer_model
from tokenizers import normalizers
from transformers import AutoConfig, AutoModel, AutoProcessor

from dynapix.conf.errors import UserError
from dynapix.conf.runs import rank
from dynapix.conf.schema import RetrieverConfig
from dynapix.data.records import RetrievalQuery
from dynapix.models.checks import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    PEFT_PREFIX,
    check_late_base,
    check_processor,
    check_text_tower,
)
from dynapix.models.compat import keep_differentiable, write_clips_as_released
from dynapix.models.distributed import main_first, rank_device
from dynapix.models.layers.attention import choose_attention
from dynapix.models.loading import (
    explain_damage,
    explain_unloadable,
    lora_config,
    name_base,
    pin_sizes,
    place_weights,
    precision_of,
    weight_options,
)
from dynapix.models.retriever.inputs import Retriever, query_form
from dynapix.models.retriever.last_token import compute_last_token
from dynapix.models.retriever.multi_vector import (
    keep_head_fp32,
    load_multi_vector,
    multi_vector_modules,
)
from dynapix.models.student.prompts import list_timestamps
from dynapix.models.tiny_qwen3_vl import build_model, build_processor
from dynapix.models.towers import find_unquantized
from dynapix.models.trained_runs import EXPORT

PROCESSING = {
    # By default, sentence-transformers truncates long inputs, even within a video. Here, inputs are
    # not truncated; `train.common.audit` raises an error before training if a query is too long.
    "text": {"truncation": False},
    "video": {"do_sample_frames": False},
    "chat_template": {"add_generation_prompt": True},
}
DEFAULT_PROMPTS = {
    "query": "Retrieve images or text relevant to the user's query.",
    "document": "Represent the user's input.",
}
"""Prompts of a chat model that is no saved retriever: those of Qwen3-VL-Embedding."""


def load_retriever(
    cfg: RetrieverConfig, precision: str, texts: list[str], folder: Path
) -> Retriever:
    """Load a retriever for training, or a released one.

    Args:
        precision: bf16 or fp32, the precision of the forward and backward passes.
        texts: Texts on which the tokenizer is trained if the base is built from an `architecture`.
        folder: Where a built base is saved before it is loaded.

    Raises:
        UserError: The model is not on this machine and cannot be downloaded; it has the processor
            of another model; it cannot be the base of a multi-vector retriever; or it shall be
            trained and reads no images, or `lora.targets` is invalid or matches no module.
    """
    source = cfg.model
    if cfg.architecture is not None:
        source = str(folder)
        with main_first():
            if rank() == 0:
                sizes = cfg.architecture
                processor = build_processor(texts, sizes.vocabulary, cfg.image_size, sizes.patch)
                build_model(cfg.architecture, len(processor.tokenizer)).save_pretrained(folder)
                processor.save_pretrained(folder)
    with explain_unloadable("retriever", source):
        model = _load_base(cfg, source, precision)
    backbone = model[0]
    if len(model) == 1 and backbone.module_output_name != "sentence_embedding":
        raise UserError(
            f"retriever.model={source} is a saved retriever without pooling, so its inputs have no "
            "embedding: save it with a Pooling module, or give a base",
            code="unsupported-model",
        )
    prepare_processor(backbone, cfg, source)
    given = {"query": cfg.query_instruction, "document": cfg.frame_instruction}
    model.prompts |= {kind: prompt for kind, prompt in given.items() if prompt is not None}
    # Training rows contain indices instead of texts, of which a model card can show no examples.
    model.model_card_data.generate_widget_examples = False
    choose_computation(model, precision, cfg)
    keep_differentiable(backbone)
    if cfg.lora.rank:
        query_form(model, cfg)
        (model if cfg.late is None else backbone).requires_grad_(False)
        with lora_config("retriever", cfg.lora, backbone.model) as config:
            model.add_adapter(config)
        name_base(backbone.model, cfg)
        for weight in backbone.parameters():
            if weight.requires_grad:
                # Updates of the adapters would vanish in bf16's rounding.
                weight.data = weight.data.float()
    return model


def _load_base(cfg: RetrieverConfig, source: str, precision: str) -> Retriever:
    """Load a saved retriever with its own modules, or a model with those of this project."""
    device = str(rank_device())
    origin = {"revision": cfg.revision, "trust_remote_code": cfg.trust_remote_code}
    kept: list[str] = []
    if cfg.quantization == "nf4":
        config = AutoConfig.from_pretrained(source, **origin)
        kept = find_unquantized(AutoModel, config, trust_remote_code=cfg.trust_remote_code)
    weights = weight_options(cfg, precision, kept)
    if cfg.late is None and is_sentence_transformer_model(source, revision=cfg.revision):
        return SentenceTransformer(source, device=device, model_kwargs=weights, **origin)
    backbone = Transformer(
        source,
        model_kwargs={**weights, **origin},
        processor_kwargs=origin,
        config_kwargs=origin,
    )
    options: dict[str, Any] = {"prompts": dict(DEFAULT_PROMPTS), "device": device}
    if cfg.late is None and backbone.module_output_name == "sentence_embedding":
        # The towers of a model such as CLIP have no prompts, and their outputs need no pooling.
        return SentenceTransformer(modules=[backbone, Normalize()], device=device)
    backbone.processing_kwargs = PROCESSING
    if cfg.late is None:
        pooling = Pooling(backbone.get_embedding_dimension(), pooling_mode="lasttoken")
        return SentenceTransformer(modules=[backbone, pooling, Normalize()], **options)
    check_late_base(source, backbone.config, cfg.revision)
    model = MultiVectorEncoder(modules=multi_vector_modules(backbone, cfg.late), **options)
    keep_head_fp32(model)
    return model


def prepare_processor(backbone: Transformer, cfg: RetrieverConfig, source: str) -> None:
    """Let the processor of a retriever's backbone give frames one size, and read inputs whole.
    Raise UserError if it is the processor of another model."""
    processor, kind, own = backbone.processor, backbone.config.model_type, {}
    if kind.startswith("qwen") and hasattr(backbone.config, "vision_config"):
        check_processor("retriever", source, backbone.config, processor)
        write_clips_as_released(processor)
        pin_sizes(processor, cfg.image_size, cfg.frames)
    elif hasattr(processor, "image_processor"):
        pin_sizes(processor, cfg.image_size, cfg.frames)
    if "message" in backbone.modality_config:
        own = {key: PROCESSING[key] for key in ("text", "video")}
    elif text_tower := getattr(backbone.config, "text_config", None):
        check_text_tower(source, backbone.config, backbone.tokenizer)
        # A text tower truncates texts, as by its authors.
        own = {"text": {"max_length": text_tower.max_position_embeddings}}
        if kind.startswith("siglip"):
            # SigLIP was trained without an attention mask, so it attends to the padding.
            own["text"] |= {"padding": "max_length", "return_attention_mask": False}
            # It was trained on text in lower case. Not every tokenizer of SigLIP 2 converts to it.
            if backbone.tokenizer.is_fast:
                fast = backbone.tokenizer.backend_tokenizer
                others = [] if fast.normalizer is None else [fast.normalizer]
                fast.normalizer = normalizers.Sequence([normalizers.Lowercase(), *others])
    settings = backbone.processing_kwargs
    backbone.processing_kwargs = {
        **settings, **{key: settings.get(key, {}) | values for key, values in own.items()}
    }  # fmt: skip


def choose_computation(model: Retriever, precision: str, cfg: RetrieverConfig) -> None:
    """Let a Qwen3-VL compute its embeddings in the fastest way for this machine."""
    choose_attention(model[0].model, precision, cfg.max_length)
    compute_last_token(model)


def load_adapters(model: Retriever, folder: Path) -> None:
    """Load adapters, and the weights of the modules after the backbone, from a folder."""
    import peft

    weights = load_file(folder / ADAPTER_WEIGHTS)
    adapters = {name.removeprefix(PEFT_PREFIX): weight for name, weight in weights.items()}
    own = peft.get_peft_model_state_dict(model[0].model, save_embedding_layers=False)
    if others := set(adapters) ^ set(own):
        raise ValueError(f"its adapters are those of another model: {min(others)}")
    peft.set_peft_model_state_dict(model[0].model, adapters)
    load_head(model, folder)


def load_head(model: Retriever, folder: Path) -> None:
    """Load the weights of the modules after a retriever's backbone (its head) from a folder."""
    for module in json.loads((folder / "modules.json").read_text())[1:]:
        weights = folder / module["path"] / "model.safetensors"
        if weights.exists():
            model[module["idx"]].load_state_dict(load_file(weights))


def load_trained(cfg: RetrieverConfig, precision: str, folder: Path) -> Retriever:
    """Load a retriever that `train.contrastive` or `train.export` saved in `folder`.

    Unless they are merged, adapters are loaded on the base of the preset, which is quantised as in
    training, with the processor in `folder`.

    Raises:
        UserError: `folder` contains no complete retriever, or its base is not on this machine.
    """
    if (folder / ADAPTER_CONFIG).exists():
        model = load_retriever(cfg, precision, [], folder)
        with explain_damage(folder):
            load_adapters(model, folder)
            model[0].processor = AutoProcessor.from_pretrained(folder)
        return model.eval()
    if (folder / EXPORT).exists():
        return load_merged(folder, cfg)
    weights = weight_options(cfg, precision, ())
    model = _load_saved(folder, cfg, model_kwargs=weights, trust_remote_code=cfg.trust_remote_code)
    if cfg.late is not None:
        keep_head_fp32(model)
    choose_computation(model, precision, cfg)
    return model


def load_merged(folder: Path, cfg: RetrieverConfig) -> Retriever:
    """Load a retriever that `train.export` merged, in the precision of its weights and with
    sentence-transformers' classes only. Raises UserError if it cannot be read."""
    weights = {"dtype": "auto", "use_safetensors": True, **place_weights()}
    model = _load_saved(folder, cfg, model_kwargs=weights)
    choose_computation(model, precision_of(model[0].model), cfg)
    return model


def _load_saved(folder: Path, cfg: RetrieverConfig, **options: Any) -> Retriever:
    load = SentenceTransformer if cfg.late is None else load_multi_vector
    with explain_damage(folder):
        return load(str(folder), local_files_only=True, **options)


def tokenizer_texts(queries: list[RetrievalQuery], cfg: RetrieverConfig) -> list[str]:
    """Return texts to train a tokenizer on: questions, instructions, roles and timestamps."""
    questions = sorted({q.question for q in queries})
    roles = ["system", "user", "assistant"]
    return [
        *questions,
        cfg.query_instruction or DEFAULT_PROMPTS["query"],
        cfg.frame_instruction or DEFAULT_PROMPTS["document"],
        *roles,
        *list_timestamps(),
    ] * 10


def longest_query(queries: list[RetrievalQuery], tokenizer: Any) -> RetrievalQuery:
    """Return the query with the most tokens. Only questions differ: all clips have one length."""
    encoded = tokenizer([q.question for q in queries], add_special_tokens=False).input_ids
    return queries[max(range(len(queries)), key=lambda k: len(encoded[k]))]
