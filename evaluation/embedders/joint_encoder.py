"""Encoders that embed a prefix and its question as one input, and the loading of all encoders."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from conf.schema import RetrieverConfig
from data.frames.frame_cache import FrameReader
from data.parallel import batched
from data.records import FrameRef
from evaluation.embedders.cache import pad_rows
from evaluation.embedders.embedder import Encoder, Query
from models.compat import keep_freed_memory
from models.retriever.embedder import frame_input, load_retriever, load_trained, query_input

if TYPE_CHECKING:
    from models.retriever.embedder import Retriever

MAX_TOKEN_PAIRS = 64 * 512**2
"""Maximum entries of the attention mask of a batch of texts: 64 texts of 512 tokens, the default
length of a response. A tokenizer may split a text into many more tokens; 64 such texts would need
many GB."""


class JointEncoder:
    """An `Encoder` that is a model of sentence-transformers."""

    def __init__(self, model: Retriever, preset: RetrieverConfig) -> None:
        self._model, self._preset = model, preset

    def embed_queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        inputs = [query_input(query, frames, self._preset) for query in queries]
        return self._encode(inputs, self._preset.query_instruction, "query")

    def embed_frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray:
        inputs = [frame_input(ref, frames) for ref in refs]
        return self._encode(inputs, self._preset.frame_instruction, "document")

    def embed_texts(self, texts: list[str]) -> np.ndarray:
        longest = max(map(len, self._model.tokenizer(texts)["input_ids"]))
        size = max(1, MAX_TOKEN_PAIRS // max(1, longest) ** 2)
        instruction = self._preset.query_instruction
        batches = [self._encode(batch, instruction, "query") for batch in batched(texts, size)]
        return np.concatenate(batches)

    def _encode(self, inputs: list[Any], prompt: str, kind: str) -> np.ndarray:
        """Embed inputs of one kind, query or document. A row holds the vector of an input, or all
        of its vectors one after the other."""
        task = {} if self._preset.late is None else {"task": kind}
        embeddings = self._model.encode(
            inputs, prompt=prompt, batch_size=len(inputs), convert_to_numpy=True,
            show_progress_bar=False, **task,
        )  # fmt: skip
        return pad_rows([np.ravel(e) for e in embeddings])


def load_encoder(preset: RetrieverConfig, precision: str, saved: Path | None) -> Encoder:
    """Load the trained retriever in `saved`, or if it is None the preset's model as released.

    Raises:
        UserError: The model cannot be loaded, is incomplete, is of another kind than `encoder`, has
            the processor of another model, or needs another number or size of frames.
    """
    keep_freed_memory()
    if saved is not None:
        return JointEncoder(load_trained(preset, precision, saved), preset)
    if preset.encoder == "vlm2vec":
        from evaluation.embedders.vlm2vec import load_vlm2vec

        return JointEncoder(load_vlm2vec(preset, precision), preset)
    if preset.encoder == "dual":
        from evaluation.embedders.dual_encoder import load_dual

        return load_dual(preset, precision)
    if preset.encoder == "languagebind":
        from evaluation.embedders.languagebind import load_languagebind

        return load_languagebind(preset, precision)
    # The texts and the folder are for building a base. `open_embedders` has already built it.
    return JointEncoder(load_retriever(preset, precision, [], Path()), preset)
