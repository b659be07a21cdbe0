"""The retriever as sentence-transformers sees it: queries of a video and a text, frames as images.

Inputs follow Qwen3-VL-Embedding: the instruction as system message, the video before the text, a
generation prompt at the end, and the last token's state, normalised, as the embedding, or as
`models.retriever.multi_vector` says. What is saved is a plain `SentenceTransformer` or
`MultiVectorEncoder`.
"""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from transformers import AutoConfig

from conf.schema import LoraConfig, RetrieverConfig
from data.records import FrameRef, RetrievalQuery, sample_prefix_frames
from data.render.frame_cache import FrameReader
from models.attention import choose_attention
from models.checks import (
    PEFT,
    check_family,
    check_modules,
    check_pooling,
    check_processor,
    check_tower,
    is_retriever,
)
from models.distributed import from_main
from models.loading import (
    DTYPES,
    UNREADABLE,
    check_reachable,
    damaged_error,
    keep_differentiable,
    load_error,
    nf4_config,
    no_targets_error,
    pin_sizes,
)
from models.retriever.multi_vector import keep_head_fp32, load_multi_vector, multi_vector_modules
from models.student.prompts import load_clip
from models.tiny_qwen3_vl import build_model, build_processor
from models.trained_runs import EXPORT

Retriever = SentenceTransformer | MultiVectorEncoder
"""With one vector, or with many."""

ADAPTERS = "adapter_model.safetensors"
"""Where adapters over a frozen base are saved."""
PROCESSING = {
    # The library's default cuts a long input, through its frames if need be; the audit refuses it.
    "text": {"truncation": False},
    "video": {"do_sample_frames": False},
    "chat_template": {"add_generation_prompt": True},
}


def load_retriever(
    cfg: RetrieverConfig, precision: str, tokenizer_texts: list[str], folder: Path
) -> Retriever:
    """A retriever ready to train. One that is built from a seed is written to `folder` first, so
    that it is loaded as any other.

    Raises:
        UserError: the model is not on this machine and cannot be fetched; it has no vision tower,
            or a processor of another model; it was saved by another pooling, or with trained
            modules after its backbone.
    """
    source = cfg.model
    if cfg.architecture is not None:
        source = from_main(partial(build_base, cfg, tokenizer_texts, folder))
    check_reachable("retriever", source)
    if is_retriever(source, cfg.revision):
        check_modules(source, cfg.revision)
        if cfg.late is None:
            check_pooling(source, cfg.revision)
    origin = {"revision": cfg.revision, "trust_remote_code": cfg.trust_remote_code}
    try:
        config = AutoConfig.from_pretrained(source, **origin)
        check_tower("retriever", source, config)
        check_family(source, config)
        backbone = Transformer(
            source,
            model_kwargs={**weight_options(cfg, precision), **origin},
            processor_kwargs=origin,
            config_kwargs=origin,
            processing_kwargs=PROCESSING,
        )
    except UNREADABLE as error:
        raise load_error("retriever", cfg.model, error) from error
    check_processor("retriever", source, config, backbone.processor)
    pin_sizes(backbone.processor, cfg.image_size, cfg.frames)
    whole = {
        "prompts": {"query": cfg.query_instruction, "document": cfg.frame_instruction},
        "device": "cuda" if torch.cuda.is_available() else "cpu",
    }
    if cfg.late is not None:
        model = MultiVectorEncoder(modules=multi_vector_modules(backbone, cfg.late), **whole)
        keep_head_fp32(model)
    else:
        pooling = Pooling(backbone.get_embedding_dimension(), pooling_mode="lasttoken")
        model = SentenceTransformer(modules=[backbone, pooling, Normalize()], **whole)
    # Rows name queries by number: there is no text of theirs that a model card could show.
    model.model_card_data.generate_widget_examples = False
    prepare_for_training(model, cfg, precision)
    return model


def prepare_for_training(model: Retriever, cfg: RetrieverConfig, precision: str) -> None:
    """Make a loaded retriever ready to train: its attention, and adapters where it has some."""
    # Prefixes are shared by masks.
    choose_attention(model[0].model, precision, cfg.max_length, masks=True)
    keep_differentiable(model[0])
    if cfg.lora.rank:
        add_adapters(model, cfg.lora)


def add_adapters(model: Retriever, lora: LoraConfig) -> None:
    """Freeze the backbone and add LoRA to its language tower's projections, in fp32 whatever the
    base has: updates of this size vanish in bf16's steps.

    Raises:
        UserError: the pattern is none, or matches no module that can be adapted.
    """
    import peft

    model[0].requires_grad_(False)
    config = peft.LoraConfig(
        r=lora.rank, lora_alpha=lora.alpha, lora_dropout=lora.dropout, target_modules=lora.targets
    )
    try:
        model.add_adapter(config)
    except (ValueError, re.error) as error:
        raise no_targets_error("retriever", lora) from error
    for weight in model[0].parameters():
        if weight.requires_grad:
            weight.data = weight.data.float()


def load_adapters(model: Retriever, folder: Path) -> None:
    """Give a retriever the adapters, and the weights of its modules after the backbone, that were
    saved of it in a folder."""
    import peft

    named = load_file(folder / ADAPTERS)
    adapters = {name.removeprefix(PEFT): weight for name, weight in named.items()}
    found = peft.set_peft_model_state_dict(model[0].model, adapters)
    if found.unexpected_keys:
        raise ValueError(f"{folder} has adapters of other layers: {found.unexpected_keys[:2]}")
    for part in json.loads((folder / "modules.json").read_text())[1:]:
        weights = folder / part["path"] / "model.safetensors"
        if weights.exists():
            model[part["idx"]].load_state_dict(load_file(weights))


def build_base(cfg: RetrieverConfig, tokenizer_texts: list[str], folder: Path) -> str:
    """The folder of a base that is built from a seed and written there."""
    assert cfg.architecture is not None
    processor = build_processor(tokenizer_texts, cfg.architecture.vocabulary, cfg.image_size)
    build_model(cfg.architecture, len(processor.tokenizer)).save_pretrained(folder)
    processor.save_pretrained(folder)
    return str(folder)


def load_trained(cfg: RetrieverConfig, precision: str, folder: Path) -> Retriever:
    """The retriever that `train.contrastive` saved in `folder`, its adapters over the same 4-bit
    weights that they were trained on.

    Raises:
        UserError: `folder` holds no whole retriever, or its base is not on this machine.
    """
    if (folder / EXPORT).exists() and not (folder / "adapter_config.json").exists():
        return load_merged(folder, cfg)
    options = {
        "model_kwargs": weight_options(cfg, precision),
        "trust_remote_code": cfg.trust_remote_code,
        "local_files_only": True,
    }
    try:
        if cfg.late is not None:
            model = load_multi_vector(folder, **options)
            keep_head_fp32(model)
        else:
            model = SentenceTransformer(str(folder), **options)
    except UNREADABLE as error:
        raise damaged_error(folder, error) from error
    choose_attention(model[0].model, precision, cfg.max_length, masks=True)
    return model


def load_merged(folder: Path, cfg: RetrieverConfig) -> Retriever:
    """A retriever merged into its base, as `train.export` wrote it: in the precision of its
    weights, and with nothing that the library does not read itself.

    Raises:
        UserError: it cannot be read.
    """
    options = {"model_kwargs": {"dtype": "auto", "use_safetensors": True}, "local_files_only": True}
    try:
        if cfg.late is not None:
            return load_multi_vector(folder, **options)
        return SentenceTransformer(str(folder), **options)
    except UNREADABLE as error:
        raise damaged_error(folder, error, "delete it and export again") from error


def weight_options(cfg: RetrieverConfig, precision: str) -> dict[str, Any]:
    """How weights are loaded: fp32 where all of them are trained, else in the precision that they
    compute in, 4-bit where the preset says so; safetensors only."""
    whole = cfg.quantization == "none" and cfg.lora.rank == 0
    dtype = torch.float32 if whole else DTYPES[precision]
    options: dict[str, Any] = {"dtype": dtype, "use_safetensors": True}
    if cfg.quantization == "nf4":
        options["quantization_config"] = nf4_config(dtype)
    return options


def tokenizer_texts(queries: list[RetrievalQuery], cfg: RetrieverConfig) -> list[str]:
    """Texts for a tokenizer built from nothing: questions, instructions and timestamps."""
    texts = sorted({q.question for q in queries})
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    roles = ["system", "user", "assistant"]
    return [*texts, cfg.query_instruction, cfg.frame_instruction, *roles, *clock] * 10


def longest_query(queries: list[RetrievalQuery], tokenizer: Any) -> RetrievalQuery:
    """The query with the most tokens. Frames are alike in all of them, so the text tells."""
    encoded = tokenizer([q.question for q in queries], add_special_tokens=False).input_ids
    return queries[max(range(len(queries)), key=lambda k: len(encoded[k]))]


def query_input(query: RetrievalQuery, frames: FrameReader, cfg: RetrieverConfig) -> dict[str, Any]:
    """A query as sentence-transformers takes it: the prefix with its true times, then the text."""
    shown = sample_prefix_frames(query.prefix_start, query.prefix_stop, cfg.frames)
    clip = load_clip(query.scene_id, shown, frames)
    array = torch.from_numpy(clip.pixels).permute(0, 3, 1, 2)
    return {"video": {"array": array, "video_metadata": clip.metadata}, "text": query.question}


def frame_input(frame: FrameRef, frames: FrameReader) -> Any:
    """A database frame as sentence-transformers takes it: an image."""
    return frames.image(frame.scene_id, frame.frame)
