"""Load retrievers with sentence-transformers, and embed queries and frames.

A query is a video and a text; a frame is an image.

Inputs follow Qwen3-VL-Embedding: the instruction is the system message, the video precedes the
text, and a generation prompt ends the input. The embedding is the normalised hidden state of the
last token, or one vector per token (`models.retriever.multi_vector`). Saved retrievers are plain
`SentenceTransformer` or `MultiVectorEncoder` models.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from tqdm import tqdm
from transformers import AutoConfig

from conf.errors import UserError
from conf.runs import world_size
from conf.schema import LoraConfig, RetrieverConfig
from data.records import FrameRef, RetrievalQuery, sample_prefix_frames
from data.render.frame_cache import FrameReader
from models.attention import choose_attention
from models.checks import PEFT, check_processor, check_tower
from models.compat import keep_differentiable
from models.distributed import from_main
from models.loading import (
    DTYPES,
    UNREADABLE,
    check_reachable,
    damaged_error,
    load_error,
    nf4_config,
    no_targets_error,
    pin_sizes,
)
from models.retriever.checks import check_family, check_modules, check_pooling, is_retriever
from models.retriever.multi_vector import keep_head_fp32, load_multi_vector, multi_vector_modules
from models.student.prompts import load_clip
from models.tiny_qwen3_vl import build_model, build_processor
from models.trained_runs import EXPORT

Retriever = SentenceTransformer | MultiVectorEncoder
"""A retriever with one vector per input, or with many."""
Item = RetrievalQuery | FrameRef
"""What a retriever embeds."""

ADAPTERS = "adapter_model.safetensors"
"""The file name of saved adapters."""
PROCESSING = {
    # By default sentence-transformers truncates long inputs, even within a video. Inputs are never
    # truncated here: `train.common.audit` raises an error before training if a query is too long.
    "text": {"truncation": False},
    "video": {"do_sample_frames": False},
    "chat_template": {"add_generation_prompt": True},
}


def load_retriever(
    cfg: RetrieverConfig, precision: str, texts: list[str], folder: Path
) -> Retriever:
    """Load a retriever for training.

    Args:
        cfg: The preset.
        precision: bf16 or fp32, the precision of the forward and backward passes.
        texts: Training texts of the tokenizer, if the preset has an `architecture` from which the
            base is built. Otherwise unused.
        folder: Where that base is saved before it is loaded.

    Raises:
        UserError: The model is not on this machine and cannot be downloaded; it is not a Qwen3-VL,
            has no vision tower or has the processor of another model; or it is a saved retriever
            with another pooling than the last token, or with trained modules after its backbone.
    """
    source = cfg.model
    if cfg.architecture is not None:
        source = from_main(partial(build_base, cfg, texts, folder))
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
    # Training rows contain indices instead of texts, so a model card has no examples to show.
    model.model_card_data.generate_widget_examples = False
    prepare_for_training(model, cfg, precision)
    return model


def prepare_for_training(model: Retriever, cfg: RetrieverConfig, precision: str) -> None:
    """Set a loaded retriever's attention, and add adapters if the preset has any."""
    choose_attention(model[0].model, precision, cfg.max_length)
    keep_differentiable(model[0])
    if cfg.lora.rank:
        add_adapters(model, cfg.lora)


def add_adapters(model: Retriever, lora: LoraConfig) -> None:
    """Freeze the backbone and add LoRA adapters to its language tower's projections.

    Adapters are fp32 even if the base is bf16: their updates are so small that bf16 would round
    them to zero.

    Raises:
        UserError: `lora.targets` is an invalid pattern, or matches no module that LoRA supports.
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
    """Load the adapters and the head that were saved in a folder into a retriever.

    The head is the modules after the backbone.
    """
    import peft

    weights = load_file(folder / ADAPTERS)
    adapters = {name.removeprefix(PEFT): weight for name, weight in weights.items()}
    loaded = peft.set_peft_model_state_dict(model[0].model, adapters)
    if loaded.unexpected_keys:
        raise ValueError(
            f"{folder} has adapters for layers that the model lacks: {loaded.unexpected_keys[:2]}"
        )
    load_head(model, folder)


def load_head(model: Retriever, folder: Path) -> None:
    """Load the weights of the modules after a retriever's backbone from a folder."""
    for part in json.loads((folder / "modules.json").read_text())[1:]:
        weights = folder / part["path"] / "model.safetensors"
        if weights.exists():
            model[part["idx"]].load_state_dict(load_file(weights))


def build_base(cfg: RetrieverConfig, texts: list[str], folder: Path) -> str:
    """Build a base with random weights from an architecture and its seed.

    The base is saved in `folder`, whose path is returned.
    """
    assert cfg.architecture is not None
    processor = build_processor(texts, cfg.architecture.vocabulary, cfg.image_size)
    build_model(cfg.architecture, len(processor.tokenizer)).save_pretrained(folder)
    processor.save_pretrained(folder)
    return str(folder)


def load_trained(cfg: RetrieverConfig, precision: str, folder: Path) -> Retriever:
    """Load a retriever that `train.contrastive` or `train.export` saved in `folder`.

    Adapters that are not merged are loaded over their base, in 4 bits if they were trained so.

    Raises:
        UserError: `folder` contains no complete retriever, or its base is not on this machine.
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
    choose_attention(model[0].model, precision, cfg.max_length)
    return model


def load_merged(folder: Path, cfg: RetrieverConfig) -> Retriever:
    """Load a merged retriever that `train.export` saved, with sentence-transformers alone.

    Its weights keep the precision in which they were saved.

    Raises:
        UserError: The retriever cannot be read.
    """
    options = {"model_kwargs": {"dtype": "auto", "use_safetensors": True}, "local_files_only": True}
    try:
        if cfg.late is not None:
            return load_multi_vector(folder, **options)
        return SentenceTransformer(str(folder), **options)
    except UNREADABLE as error:
        raise damaged_error(folder, error, "delete it and export again") from error


def weight_options(cfg: RetrieverConfig, precision: str) -> dict[str, Any]:
    """Return the arguments of `from_pretrained` for the weights.

    Weights are fp32 if all of them are trained. Otherwise they have the given precision, or 4 bits
    if the preset quantizes the base. Only safetensors files are read.
    """
    trains_all = cfg.quantization == "none" and cfg.lora.rank == 0
    dtype = torch.float32 if trains_all else DTYPES[precision]
    options: dict[str, Any] = {"dtype": dtype, "use_safetensors": True}
    if cfg.quantization == "nf4":
        options["quantization_config"] = nf4_config(dtype)
    return options


def tokenizer_texts(queries: list[RetrievalQuery], cfg: RetrieverConfig) -> list[str]:
    """Texts to train a tokenizer on: questions, instructions, roles and timestamps."""
    questions = sorted({q.question for q in queries})
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    roles = ["system", "user", "assistant"]
    return [*questions, cfg.query_instruction, cfg.frame_instruction, *roles, *clock] * 10


def longest_query(queries: list[RetrievalQuery], tokenizer: Any) -> RetrievalQuery:
    """The query with the most tokens. All clips have the same length, so only texts differ."""
    encoded = tokenizer([q.question for q in queries], add_special_tokens=False).input_ids
    return queries[max(range(len(queries)), key=lambda k: len(encoded[k]))]


def query_input(query: RetrievalQuery, frames: FrameReader, cfg: RetrieverConfig) -> dict[str, Any]:
    """A query as sentence-transformers takes it: the prefix with its true times, then the text."""
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, cfg.frames)
    clip = load_clip(query.scene_id, indices, frames)
    array = torch.from_numpy(clip.pixels).permute(0, 3, 1, 2)
    return {"video": {"array": array, "video_metadata": clip.metadata}, "text": query.question}


def frame_input(frame: FrameRef, frames: FrameReader) -> Any:
    """A database frame as sentence-transformers takes it: an image."""
    return frames.image(frame.scene_id, frame.frame)


def item_input(item: Item, frames: FrameReader, cfg: RetrieverConfig) -> Any:
    """A query or a frame as sentence-transformers takes it."""
    if isinstance(item, FrameRef):
        return frame_input(item, frames)
    return query_input(item, frames, cfg)


def instruction_of(item: Item, cfg: RetrieverConfig) -> str:
    """The system message of a query or of a frame."""
    return cfg.frame_instruction if isinstance(item, FrameRef) else cfg.query_instruction


def item_name(item: Item) -> str:
    """The name of a query or of a frame in messages."""
    if isinstance(item, FrameRef):
        return f"frame {item.frame} of {item.scene_id}"
    return f"query {item.query_id}"


def embed(
    model: Retriever,
    items: Sequence[Item],
    frames: FrameReader,
    cfg: RetrieverConfig,
    batch: int,
    progress: str | None = None,
) -> list[torch.Tensor]:
    """Embed queries or frames. Items are all of one kind.

    Args:
        batch: Items per rank of which pixels are in memory at a time.
        progress: Label of a progress bar; None shows none.

    Returns:
        An fp32 tensor on the CPU for each item, (width,) or (vectors, width).

    Raises:
        UserError: An embedding is not finite.
    """
    encode = model.encode_document if isinstance(items[0], FrameRef) else model.encode_query
    rows: list[torch.Tensor] = []
    # In a distributed evaluation, each call divides its inputs among the ranks.
    step = batch * world_size()
    starts = range(0, len(items), step)
    for start in tqdm(starts, desc=progress, unit="batch", leave=False, disable=progress is None):
        part = items[start : start + step]
        embedded = encode(
            [item_input(item, frames, cfg) for item in part],
            prompt=instruction_of(items[0], cfg),
            batch_size=batch,
            show_progress_bar=False,
        )
        vectors = [torch.as_tensor(row).float().cpu() for row in embedded]
        check_finite(vectors, part)
        rows += vectors
    return rows


def check_finite(vectors: Sequence[torch.Tensor], items: Sequence[Item]) -> None:
    """Raise UserError if the embedding of an item has a NaN or an Inf."""
    for item, embedded in zip(items, vectors, strict=True):
        if not embedded.isfinite().all():
            raise UserError(
                f"non-finite embedding (NaN or Inf) for {item_name(item)}: lower train.lr or set "
                "train.precision=fp32; the checkpoints written so far are kept",
                code="non-finite-embedding",
            )
