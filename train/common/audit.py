"""Check a loaded model and its longest input before the first step, and describe both in a log."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any

from torch import nn
from transformers import PreTrainedTokenizerBase, ProcessorMixin

from dynapix.conf.errors import UserError
from dynapix.conf.schema import RetrieverConfig, StudentConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.models.checks import check_widths
from dynapix.models.retriever.inputs import Retriever, model_inputs, preprocess
from dynapix.models.retriever.multi_vector import find_scored_tokens
from dynapix.models.student.collator import IGNORED, Collator
from dynapix.models.student.prompts import Sample
from dynapix.models.towers import check_parameter_counts, count_parameters


def audit_student(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig,
    sample: Sample,
    collator: Collator,
) -> str:
    """Return the parameter counts by tower, the sizes of the frames in vision tokens, and the
    decoded longest sample, with its supervised tokens between >>> and <<<.

    Raises:
        UserError: the parameter counts contradict the preset, or the sample is too long.
    """
    batch = collator([sample])
    ids = batch["input_ids"][0].tolist()
    labels = batch["labels"][0]
    supervised = [False] * (len(ids) - len(labels)) + (labels != IGNORED).tolist()
    return "\n".join(
        [
            *describe_model(model, processor, cfg, batch),
            *describe_input(
                "the longest sample", processor.tokenizer, ids, supervised, "supervised"
            ),
        ]
    )


def audit_retriever(
    model: Retriever, cfg: RetrieverConfig, query: RetrievalQuery, frames: FrameReader
) -> str:
    """Return the parameter counts by tower, the sizes of the frames in vision tokens, and the
    decoded longest query and its target, with the scored tokens between >>> and <<<.

    Raises:
        UserError: the parameter counts contradict the preset, the embeddings have fewer entries
            than the widest width, or the query is too long.
    """
    if cfg.late is None:
        check_widths(cfg, model.get_embedding_dimension())
    query_inputs, frame_inputs = (
        preprocess(model, *model_inputs(model, [one], frames, cfg)) for one in (query, query.target)
    )
    # A model with separate towers reads the question alone, and a frame without tokens.
    query_inputs = query_inputs.get("texts", query_inputs)
    length = query_inputs["input_ids"].shape[1]
    if length > cfg.max_length:
        raise UserError(
            f"query {query.query_id} has {length} tokens, more than retriever.max_length="
            f"{cfg.max_length}: raise it, or lower retriever.image_size or retriever.frames",
            code="sample-too-long",
        )
    lines = describe_model(model, model[0].processor, cfg, {**frame_inputs, **query_inputs})
    for name, inputs in (("the longest query", query_inputs), ("a frame", frame_inputs)):
        if (ids := inputs.get("input_ids")) is None:
            continue
        if cfg.late is None:
            # The embedding is the hidden state of the last token, or pools those of all tokens.
            one = any(getattr(part, "pooling_mode", None) == "lasttoken" for part in model)
            scored = [not one or k == ids.shape[1] - 1 for k in range(ids.shape[1])]
        else:
            mask = inputs["attention_mask"]
            scored = find_scored_tokens(model).scored(ids, mask)[0].tolist()
        lines += describe_input(name, model.tokenizer, ids[0].tolist(), scored, "scored")
    return "\n".join(lines)


def describe_model(
    model: nn.Module,
    processor: ProcessorMixin,
    cfg: StudentConfig | RetrieverConfig,
    inputs: Mapping[str, Any],
) -> list[str]:
    """Compare the parameter counts with the preset, and return lines with the counts and the grids
    of vision tokens in a Qwen's `inputs` (time x rows x columns; a step of time is a pair of
    frames)."""
    towers = count_parameters(model)
    check_parameter_counts(towers, cfg.name, cfg.quantization, cfg.lora.rank)
    grids = []
    for name, medium in (("video_grid_thw", "a video"), ("image_grid_thw", "an image")):
        if name in inputs:
            time, height, width = inputs[name][0].tolist()
            merge = processor.image_processor.merge_size
            grids.append(f"{medium} of {time} x {height // merge} x {width // merge} tokens")
    lines = [
        f"audit of {cfg.name} ({cfg.quantization}, {'LoRA' if cfg.lora.rank else 'all weights'})",
        towers.map("{:,}".format).rename_axis(None).to_string(),
    ]
    if grids:
        size = cfg.image_size
        lines.append(f"frames of {size} x {size} px become {' and '.join(grids)}")
    return lines


def describe_input(
    name: str,
    tokenizer: PreTrainedTokenizerBase,
    ids: Sequence[int],
    marked: Sequence[bool],
    meaning: str,
) -> list[str]:
    """Return two lines: the number of tokens of an input, and its text, with the marked tokens
    between >>> and <<<, and of consecutive vision tokens only the first."""
    text = ""
    for is_marked, pairs in groupby(zip(ids, marked, strict=True), itemgetter(1)):
        decoded = tokenizer.decode([token for token, _ in pairs])
        text += f">>>{decoded}<<<" if is_marked else decoded
    return [
        f"{name} has {len(ids)} tokens, {sum(marked)} of them {meaning}:",
        re.sub(r"(<[^<>]+>)\1+", r"\1...", text),
    ]
