"""Load retrievers with sentence-transformers, and embed queries and frames.

Inputs have the form of Qwen3-VL-Embedding's: the instruction is the system message, a video and a
question (a query) or an image (a frame) are the user message, and a generation prompt follows. The
embedding is the normalised hidden state of the last token, or one vector per token
(`models.retriever.multi_vector`). Saved retrievers are plain `SentenceTransformer` or
`MultiVectorEncoder` models.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from sentence_transformers.util import is_sentence_transformer_model
from transformers import AutoConfig

from conf.errors import UserError
from conf.runs import rank, world_size
from conf.schema import RetrieverConfig
from data.frames.frame_cache import FrameReader
from data.records import FrameRef, RetrievalQuery, sample_prefix_frames
from models.attention import choose_attention
from models.checks import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    PEFT_PREFIX,
    check_is_qwen3_vl,
    check_modules,
    check_processor,
)
from models.compat import keep_differentiable, write_clips_as_released
from models.distributed import main_first
from models.loading import (
    check_available,
    explain_damage,
    explain_unloadable,
    lora_config,
    pin_sizes,
    weight_options,
)
from models.retriever.multi_vector import keep_head_fp32, load_multi_vector, multi_vector_modules
from models.student.prompts import list_timestamps, load_clip
from models.tiny_qwen3_vl import build_model, build_processor
from models.trained_runs import EXPORT

Retriever = SentenceTransformer | MultiVectorEncoder
"""A single-vector or a multi-vector retriever."""
QueryOrFrame = RetrievalQuery | FrameRef
"""An input of a retriever."""

UNQUANTIZED = ("visual",)
"""Modules of a Qwen3-VL without a head that are not quantised."""
PROCESSING = {
    # By default, sentence-transformers truncates long inputs, even within a video. Here, inputs are
    # not truncated; `train.common.audit` raises an error before training if a query is too long.
    "text": {"truncation": False},
    "video": {"do_sample_frames": False},
    "chat_template": {"add_generation_prompt": True},
}


def load_retriever(
    cfg: RetrieverConfig, precision: str, texts: list[str], folder: Path
) -> Retriever:
    """Load a retriever for training.

    Args:
        precision: bf16 or fp32, the precision of the forward and backward passes.
        texts: Texts on which the tokenizer is trained if the base is built from an `architecture`.
        folder: Where a built base is saved before it is loaded.

    Raises:
        UserError: The model is not on this machine and cannot be downloaded; it is not a Qwen3-VL
            or has the processor of another model; it is a saved retriever that does not pool the
            last token, or that has other modules after its backbone; or `lora.targets` is an
            invalid pattern or matches no module that LoRA supports.
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
    origin = {"revision": cfg.revision, "trust_remote_code": cfg.trust_remote_code}
    with explain_unloadable("retriever", source):
        if is_sentence_transformer_model(source, revision=cfg.revision):
            check_modules(source, cfg.revision, late=cfg.late is not None)
        config = AutoConfig.from_pretrained(source, **origin)
        check_is_qwen3_vl(source, config)
        backbone = Transformer(
            source,
            model_kwargs={**weight_options(cfg, precision, UNQUANTIZED), **origin},
            processor_kwargs=origin,
            config_kwargs=origin,
            processing_kwargs=PROCESSING,
        )
    check_processor("retriever", source, config, backbone.processor)
    write_clips_as_released(backbone.processor)
    pin_sizes(backbone.processor, cfg.image_size, cfg.frames)
    options = {
        "prompts": {"query": cfg.query_instruction, "document": cfg.frame_instruction},
        "device": "cuda" if torch.cuda.is_available() else "cpu",
    }
    if cfg.late is not None:
        model = MultiVectorEncoder(modules=multi_vector_modules(backbone, cfg.late), **options)
        keep_head_fp32(model)
    else:
        pooling = Pooling(backbone.get_embedding_dimension(), pooling_mode="lasttoken")
        model = SentenceTransformer(modules=[backbone, pooling, Normalize()], **options)
    # Training rows contain indices instead of texts, of which a model card can show no examples.
    model.model_card_data.generate_widget_examples = False
    choose_attention(backbone.model, precision, cfg.max_length)
    keep_differentiable(backbone)
    if cfg.lora.rank:
        backbone.requires_grad_(False)
        with lora_config("retriever", cfg.lora, backbone.model) as config:
            model.add_adapter(config)
        for weight in backbone.parameters():
            if weight.requires_grad:
                # Updates of the adapters would vanish in bf16's rounding.
                weight.data = weight.data.float()
    return model


def load_adapters(model: Retriever, folder: Path) -> None:
    """Load adapters, and the weights of the modules after the backbone, from a folder."""
    import peft

    weights = load_file(folder / ADAPTER_WEIGHTS)
    adapters = {name.removeprefix(PEFT_PREFIX): weight for name, weight in weights.items()}
    loaded = peft.set_peft_model_state_dict(model[0].model, adapters)
    if loaded.unexpected_keys:
        raise ValueError(
            f"{folder} has adapters for layers that the model lacks: {loaded.unexpected_keys[:2]}"
        )
    load_head(model, folder)


def load_head(model: Retriever, folder: Path) -> None:
    """Load the weights of the modules after a retriever's backbone (its head) from a folder."""
    for module in json.loads((folder / "modules.json").read_text())[1:]:
        weights = folder / module["path"] / "model.safetensors"
        if weights.exists():
            model[module["idx"]].load_state_dict(load_file(weights))


def load_trained(cfg: RetrieverConfig, precision: str, folder: Path) -> Retriever:
    """Load a retriever that `train.contrastive` or `train.export` saved in `folder`.

    Unless they are merged, adapters are loaded on their base, which is quantised as in training.

    Raises:
        UserError: `folder` contains no complete retriever, or its base is not on this machine.
    """
    if (folder / EXPORT).exists() and not (folder / ADAPTER_CONFIG).exists():
        return load_merged(folder, cfg)
    if (folder / ADAPTER_CONFIG).exists() and cfg.model is not None:
        # Otherwise a missing base would look like a damaged run.
        check_available("retriever", cfg.model)
    weights = weight_options(cfg, precision, UNQUANTIZED)
    model = _load_saved(folder, cfg, model_kwargs=weights, trust_remote_code=cfg.trust_remote_code)
    if cfg.late is not None:
        keep_head_fp32(model)
    choose_attention(model[0].model, precision, cfg.max_length)
    return model


def load_merged(folder: Path, cfg: RetrieverConfig) -> Retriever:
    """Load a retriever that `train.export` merged, in the precision of its weights and with
    sentence-transformers' classes only. Raises UserError if it cannot be read."""
    return _load_saved(folder, cfg, model_kwargs={"dtype": "auto", "use_safetensors": True})


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
        cfg.query_instruction,
        cfg.frame_instruction,
        *roles,
        *list_timestamps(),
    ] * 10


def longest_query(queries: list[RetrievalQuery], tokenizer: Any) -> RetrievalQuery:
    """Return the query with the most tokens. Only questions differ: all clips have one length."""
    encoded = tokenizer([q.question for q in queries], add_special_tokens=False).input_ids
    return queries[max(range(len(queries)), key=lambda k: len(encoded[k]))]


def query_input(query: RetrievalQuery, frames: FrameReader, cfg: RetrieverConfig) -> dict[str, Any]:
    """Return a query as an input of sentence-transformers: the prefix as a video with its true
    times, and the question."""
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, cfg.frames)
    clip = load_clip(query.scene_id, indices, frames)
    array = torch.from_numpy(clip.pixels).permute(0, 3, 1, 2)
    return {"video": {"array": array, "video_metadata": clip.metadata}, "text": query.question}


def frame_input(frame: FrameRef, frames: FrameReader) -> Any:
    """Return a frame as an input of sentence-transformers: an image."""
    return frames.image(frame.scene_id, frame.frame)


def model_inputs(
    items: Sequence[QueryOrFrame], frames: FrameReader, cfg: RetrieverConfig
) -> tuple[list[Any], str]:
    """Return inputs of sentence-transformers, and their instruction; all items are of one type."""
    if isinstance(items[0], FrameRef):
        return [frame_input(frame, frames) for frame in items], cfg.frame_instruction
    return [query_input(query, frames, cfg) for query in items], cfg.query_instruction


def embed(
    model: Retriever,
    items: Sequence[QueryOrFrame],
    frames: FrameReader,
    cfg: RetrieverConfig,
    batch: int,
) -> list[torch.Tensor]:
    """Embed queries or frames; all items are of one type.

    Args:
        batch: Number of items per rank whose pixels are in memory at the same time.

    Returns:
        For each item an fp32 tensor on the CPU, (width,) or, with many vectors, (vectors, width).

    Raises:
        UserError: An embedding is not finite.
    """
    encode = model.encode_document if isinstance(items[0], FrameRef) else model.encode_query
    rows: list[torch.Tensor] = []
    # In a distributed evaluation, each call divides its inputs among the ranks.
    step = batch * world_size()
    for start in range(0, len(items), step):
        part = items[start : start + step]
        inputs, instruction = model_inputs(part, frames, cfg)
        embedded = encode(inputs, prompt=instruction, batch_size=batch, show_progress_bar=False)
        vectors = [torch.as_tensor(row).float().cpu() for row in embedded]
        check_finite(vectors, part)
        rows += vectors
    return rows


def check_finite(vectors: Sequence[torch.Tensor], items: Sequence[QueryOrFrame]) -> None:
    """Raise UserError if the embedding of an item has a NaN or an Inf."""
    for item, embedded in zip(items, vectors, strict=True):
        if not embedded.isfinite().all():
            kind = "frame" if isinstance(item, FrameRef) else "query"
            raise UserError(
                f"non-finite embedding (NaN or Inf) for {kind} {item.name}: lower train.lr or set "
                "train.precision=fp32; the checkpoints written so far are kept",
                code="non-finite-embedding",
            )
