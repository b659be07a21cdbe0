"""Print and check the loaded model and its longest input before a run's first step."""

from __future__ import annotations

import re
from itertools import groupby

from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from sentence_transformers.multi_vector_encoder.modules import HierarchicalTokenPooling
from torch import nn
from transformers import ProcessorMixin

from conf.errors import UserError
from conf.schema import RetrieverConfig, StudentConfig
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from models.parameter_counts import check_towers, count_towers, format_towers
from models.retriever.checks import check_widths
from models.retriever.embedder import Retriever, frame_input, query_input
from models.retriever.multi_vector import find_scored_tokens
from models.student.collator import IGNORED, Collator
from models.student.prompts import Sample


def audit(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    sample: Sample,
    collator: Collator,
) -> str:
    """Return the parameter counts by tower, the grids of the frames, and the longest sample,
    decoded, with its supervised part between >>> and <<<.

    Raises:
        UserError: the counts differ from the preset, or the sample is too long.
    """
    towers = count_towers(model)
    check_towers(towers, cfg.name, cfg.quantization, cfg.lora.rank)
    batch = collator([sample])
    ids = batch["input_ids"][0]
    supervised = int((batch["labels"] != IGNORED).sum())
    prompt, response = ids[: len(ids) - supervised], ids[len(ids) - supervised :]
    decode = processor.tokenizer.decode
    return "\n".join(
        [
            f"audit of {cfg.name} ({cfg.quantization}, {'LoRA' if cfg.lora.rank else 'whole'})",
            format_towers(towers),
            f"frames of {cfg.image_size} x {cfg.image_size} px become {grids(batch, processor)}",
            f"the longest sample has {len(ids)} tokens, {supervised} of them supervised:",
            f"{squeeze(decode(prompt))}>>>{squeeze(decode(response))}<<<",
        ]
    )


def audit_retriever(
    model: Retriever, cfg: RetrieverConfig, query: RetrievalQuery, frames: FrameReader
) -> str:
    """The same for a retriever: counts, grids, the longest query and a frame, decoded; where it has
    many vectors, what is scored of them between >>> and <<<.

    Raises:
        UserError: the counts are not what the preset says, the model is narrower than its widest
            width, or the query is too long.
    """
    towers = count_towers(model)
    check_towers(towers, cfg.name, cfg.quantization, cfg.lora.rank)
    if cfg.late is None:
        check_widths(cfg, model.get_embedding_dimension())
    processor = model[0].processor
    query_inputs = model.preprocess([query_input(query, frames, cfg)], prompt=cfg.query_instruction)
    length = query_inputs["input_ids"].shape[1]
    if length > cfg.max_length:
        raise UserError(
            f"query {query.query_id} has {length} tokens, more than retriever.max_length="
            f"{cfg.max_length}: raise it, or lower retriever.image_size or retriever.frames",
            code="sample-too-long",
        )
    frame_inputs = model.preprocess(
        [frame_input(query.target, frames)], prompt=cfg.frame_instruction
    )
    return "\n".join(
        [
            f"audit of {cfg.name} ({cfg.quantization}, {'LoRA' if cfg.lora.rank else 'whole'})",
            format_towers(towers),
            f"frames of {cfg.image_size} x {cfg.image_size} px become "
            f"{grids(query_inputs | {k: frame_inputs[k] for k in ('image_grid_thw',)}, processor)}",
            *(describe_last_tokens if cfg.late is None else describe_scored_tokens)(
                model, query_inputs, frame_inputs
            ),
        ]
    )


def describe_last_tokens(
    model: SentenceTransformer, query_inputs: dict, frame_inputs: dict
) -> list[str]:
    """Decode a query and a frame."""
    query, frame = (features["input_ids"][0] for features in (query_inputs, frame_inputs))
    decode = model.tokenizer.decode
    return [
        f"the longest query has {len(query)} tokens and is embedded at the last one:",
        squeeze(decode(query)),
        f"a frame of {len(frame)} tokens:",
        squeeze(decode(frame)),
    ]


def describe_scored_tokens(
    model: MultiVectorEncoder, query_inputs: dict, frame_inputs: dict
) -> list[str]:
    """Decode a query and a frame, with the scored tokens between >>> and <<<."""
    lines = []
    for name, features in (("the longest query", query_inputs), ("a frame", frame_inputs)):
        ids, attended = features["input_ids"], features["attention_mask"]
        scored = find_scored_tokens(model).scored(ids, attended)[0].tolist()
        runs = [
            (kept, model.tokenizer.decode([token for token, _ in run]))
            for kept, run in groupby(zip(ids[0].tolist(), scored, strict=True), lambda one: one[1])
        ]
        lines += [
            f"{name} has {len(scored)} tokens, {sum(scored)} of them scored:",
            squeeze("".join(f">>>{text}<<<" if kept else text for kept, text in runs)),
        ]
    pools = [module for module in model if isinstance(module, HierarchicalTokenPooling)]
    return [*lines, *(f"a frame keeps one of {p.pool_factor} of its vectors" for p in pools)]


def grids(batch: dict, processor: ProcessorMixin) -> str:
    """Describe the vision tokens of a batch as frames x rows x columns."""
    merge = processor.image_processor.merge_size
    descriptions = []
    for name, what in (("video_grid_thw", "a video"), ("image_grid_thw", "an image")):
        if name in batch:
            time, height, width = batch[name][0].tolist()
            rows, columns = height // merge, width // merge
            descriptions.append(f"{what} of {time} x {rows} x {columns} tokens")
    return " and ".join(descriptions)


def squeeze(text: str) -> str:
    """Shorten each run of vision tokens in a decoded text to one."""
    return re.sub(r"(<\|(image|video)_pad\|>)+", r"\1...", text)
