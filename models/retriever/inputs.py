"""The inputs and outputs of retrievers.

By what the model reads, a query has one of three forms:

- video: the prefix as a video with its true times, and the question. Only Qwen3-VL's processor
  writes true times.
- images: a chat message with the frames of the prefix, each after its time, and the question.
- separate: for a model with an image tower and a text tower, such as CLIP. The embedding of a
  prefix is the mean of the unit embeddings of its frames, and the embedding of a query is the sum
  of the unit embeddings of its prefix and its question, as in published baselines.

A frame is always an image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from PIL.Image import Image
from sentence_transformers import MultiVectorEncoder, SentenceTransformer
from torch.nn.functional import normalize
from transformers import Qwen3VLProcessor

from dynapix.conf.errors import UserError
from dynapix.conf.runs import world_size
from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FrameRef, RetrievalQuery, SelectionItem, sample_prefix_frames
from dynapix.models.student.prompts import load_clip, write_time

Retriever = SentenceTransformer | MultiVectorEncoder
"""A single-vector or a multi-vector retriever."""
Query = RetrievalQuery | SelectionItem
QueryOrFrame = Query | FrameRef
"""An input of a retriever."""
IMAGES = 64
"""Maximum number of images that an image tower embeds together."""


@dataclass(frozen=True)
class SeparateQuery:
    """A query whose frames and question are embedded separately."""

    images: list[Image]
    text: str


def query_form(model: Retriever, cfg: RetrieverConfig) -> str:
    """Return the form of a model's queries: video, images or separate.

    Raises:
        UserError: The model reads no images, or images only together with a text.
    """
    modalities = model[0].modality_config
    if cfg.encoder == "vlm2vec" or isinstance(model[0].processor, Qwen3VLProcessor):
        return "video"
    if {"image", "message"} <= set(modalities):
        return "images"
    if {"image", "text"} <= set(modalities):
        return "separate"
    raise UserError(
        f"{cfg.name} ({cfg.model}) cannot embed a frame, only {', '.join(map(str, modalities))}: "
        "as a matcher, it needs routes=[predict_caption]; as a retriever, give a model that reads "
        "images",
        code="no-images",
    )


def query_input(
    query: Query, frames: FrameReader, cfg: RetrieverConfig, form: str = "video"
) -> Any:
    """Return a query in a form that `query_form` returns."""
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, cfg.frames)
    if form == "video":
        clip = load_clip(query.scene_id, indices, frames)
        array = torch.from_numpy(clip.pixels).permute(0, 3, 1, 2)
        return {"video": {"array": array, "video_metadata": clip.metadata}, "text": query.question}
    if form == "separate":
        images = [frames.image(query.scene_id, index) for index in indices]
        return SeparateQuery(images, query.question)
    return query_messages(query, frames, cfg.frames)


def query_messages(query: Query, frames: FrameReader, count: int) -> list[dict[str, Any]]:
    """Return a query as a chat message: `count` frames of its prefix as images, each after its
    time, and the question."""
    fps, content = frames.scene(query.scene_id).fps, []
    for index in sample_prefix_frames(query.prefix_start, query.prefix_stop, count):
        content.append({"type": "text", "text": write_time(index / fps)})
        content.append({"type": "image", "image": frames.image(query.scene_id, index)})
    content.append({"type": "text", "text": query.question})
    return [{"role": "user", "content": content}]


def frame_input(frame: FrameRef, frames: FrameReader) -> Image:
    """Return a frame as an image."""
    return frames.image(frame.scene_id, frame.frame)


def model_inputs(
    model: Retriever, items: Sequence[QueryOrFrame], frames: FrameReader, cfg: RetrieverConfig
) -> tuple[list[Any], str]:
    """Return inputs for `preprocess` and `encode`, and their kind, query or document; all items are
    of one kind."""
    form = query_form(model, cfg)
    if isinstance(items[0], FrameRef):
        return [frame_input(frame, frames) for frame in items], "document"
    return [query_input(query, frames, cfg, form) for query in items], "query"


def preprocess(model: Retriever, inputs: Sequence[Any], kind: str) -> dict[str, Any]:
    """Return inputs of one kind as tensors for `forward`."""
    prompt = model.prompts.get(kind)
    if not isinstance(inputs[0], SeparateQuery):
        return model.preprocess(inputs, prompt=prompt)
    return {
        "images": model.preprocess([image for query in inputs for image in query.images]),
        "texts": model.preprocess([query.text for query in inputs], prompt=prompt),
        "counts": [len(query.images) for query in inputs],
    }


def forward(model: Any, features: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Return a model's outputs for the tensors of `preprocess`, which stay unchanged."""
    if "counts" not in features:
        # The outputs have the type of the inputs, and DDP finds their tensors in a plain dict only.
        return model(dict(features), task=kind)
    images, texts = (
        model(dict(features[part]), task=kind)["sentence_embedding"] for part in ("images", "texts")
    )
    return {"sentence_embedding": add_questions(images, texts, features["counts"])}


def add_questions(images: torch.Tensor, texts: torch.Tensor, counts: Sequence[int]) -> torch.Tensor:
    """Return the unit embeddings (queries, width) of separate queries.

    Args:
        images: Embeddings (frames of all queries, width).
        texts: Embeddings (queries, width) of the questions.
        counts: Number of frames of each query.
    """
    means = [frames.mean(dim=0) for frames in normalize(images, dim=-1).split(counts)]
    prefixes = normalize(torch.stack(means), dim=-1)
    return normalize(prefixes + normalize(texts, dim=-1), dim=-1)


def encode(model: Retriever, inputs: Sequence[Any], kind: str, batch: int) -> list[torch.Tensor]:
    """Embed inputs of one kind: queries or texts (query), or frames (document).

    Returns:
        For each input an fp32 tensor on the CPU, (width,) or, with many vectors, (vectors, width).
    """
    if isinstance(inputs[0], SeparateQuery):
        pictures = [image for query in inputs for image in query.images]
        images = torch.stack(encode(model, pictures, "document", IMAGES))
        texts = torch.stack(encode(model, [query.text for query in inputs], "query", batch))
        return list(add_questions(images, texts, [len(query.images) for query in inputs]))
    call = model.encode_query if kind == "query" else model.encode_document
    prompt = model.prompts.get(kind)
    rows = call(inputs, prompt=prompt, batch_size=batch, show_progress_bar=False)
    return [torch.as_tensor(row).float().cpu() for row in rows]


def embed(
    model: Retriever,
    items: Sequence[QueryOrFrame],
    frames: FrameReader,
    cfg: RetrieverConfig,
    batch: int,
) -> list[torch.Tensor]:
    """Embed queries or frames as `encode` does; all items are of one kind.

    Args:
        batch: Number of items per rank whose pixels are in memory at the same time.

    Raises:
        UserError: An embedding is not finite, or the model cannot embed a frame.
    """
    rows: list[torch.Tensor] = []
    # In a distributed evaluation, each call divides its inputs among the ranks.
    step = batch * world_size()
    for start in range(0, len(items), step):
        part = items[start : start + step]
        vectors = encode(model, *model_inputs(model, part, frames, cfg), batch)
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
