"""Encoders that embed a prefix and its question as one input, and the loading of all encoders."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dynapix.conf.schema import RetrieverConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FrameRef
from dynapix.evaluation.embedders.cache import pad_rows
from dynapix.models.compat import keep_freed_memory
from dynapix.models.retriever.embedder import load_retriever, load_trained
from dynapix.models.retriever.inputs import Query, Retriever, encode, model_inputs


class Encoder(Protocol):
    """A loaded model. Its methods return fp32 embeddings (inputs, entries)."""

    def embed_queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        """Embed prefixes with their questions."""

    def embed_frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray: ...

    def embed_texts(self, texts: list[str]) -> np.ndarray:
        """Embed texts as queries without a prefix."""


class JointEncoder:
    """An `Encoder` that is a model of sentence-transformers."""

    def __init__(self, model: Retriever, preset: RetrieverConfig) -> None:
        self._model, self._preset = model, preset

    def embed_queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        return self._encode(*model_inputs(self._model, queries, frames, self._preset))

    def embed_frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray:
        return self._encode(*model_inputs(self._model, refs, frames, self._preset))

    def embed_texts(self, texts: list[str]) -> np.ndarray:
        return self._encode(texts, "query")

    def _encode(self, inputs: list[Any], kind: str) -> np.ndarray:
        """Embed inputs of one kind, query or document. A row holds the vector of an input, or all
        of its vectors one after the other."""
        return pad_rows([v.numpy().ravel() for v in encode(self._model, inputs, kind, len(inputs))])


def load_encoder(preset: RetrieverConfig, precision: str, saved: Path | None) -> Encoder:
    """Load the trained retriever in `saved`, or if it is None the preset's model as released.

    Raises:
        UserError: The model cannot be loaded, is incomplete, is of another kind than `encoder`, has
            the processor of another model, or needs another number of frames.
    """
    keep_freed_memory()
    if saved is not None:
        return JointEncoder(load_trained(preset, precision, saved), preset)
    if preset.encoder == "vlm2vec":
        from dynapix.evaluation.embedders.vlm2vec import load_vlm2vec

        return JointEncoder(load_vlm2vec(preset, precision), preset)
    if preset.encoder == "languagebind":
        from dynapix.evaluation.embedders.languagebind import load_languagebind

        return load_languagebind(preset, precision)
    # The texts and the folder are for building a base. `open_embedders` has already built it.
    return JointEncoder(load_retriever(preset, precision, [], Path()), preset)
