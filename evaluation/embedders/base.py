"""One interface for whatever embeds queries, frames and texts, and the encoders that read a prefix
and its question together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from PIL import Image

from conf.schema import RetrieverConfig
from data.records import FrameRef, RetrievalQuery, SelectionItem
from data.render.frame_cache import FrameReader
from evaluation.retrieval.late_interaction import embedded_rows
from models.compat import keep_freed_memory
from models.retriever.embedder import frame_input, load_retriever, load_trained, query_input

if TYPE_CHECKING:
    from pathlib import Path

    from models.retriever.embedder import Retriever

Query = RetrievalQuery | SelectionItem
PAIRS = 64 * 512**2
"""Pairs of tokens at most in the attention mask of texts that pass a model at once: 64 texts of 512
tokens, which is as long as a model writes by default. What a tokenizer has never seen it splits
into many more, and the mask of 64 such texts takes many GB."""


class Encoder(Protocol):
    """Gives (things, entries) fp32 embeddings; pixels come from `frames` at the preset's size."""

    def queries(self, asked: list[Query], frames: FrameReader) -> np.ndarray:
        """Of prefixes with their questions."""

    def frames(self, shown: list[FrameRef], frames: FrameReader) -> np.ndarray: ...

    def drawn(self, shown: list[np.ndarray]) -> np.ndarray:
        """Of (S, S, 3) uint8 pixels at the preset's size, as of frames."""

    def texts(self, texts: list[str]) -> np.ndarray:
        """Of texts that stand for a query by themselves."""


class JointEncoder:
    """A retriever of sentence-transformers: a prefix and its question are one input, after an
    instruction of their own."""

    def __init__(self, model: Retriever, preset: RetrieverConfig) -> None:
        self._model, self._preset = model, preset

    def queries(self, asked: list[Query], frames: FrameReader) -> np.ndarray:
        shown = [query_input(query, frames, self._preset) for query in asked]
        return self._embedded(shown, self._preset.query_instruction, "query")

    def frames(self, shown: list[FrameRef], frames: FrameReader) -> np.ndarray:
        return self._pictures([frame_input(frame, frames) for frame in shown])

    def drawn(self, shown: list[np.ndarray]) -> np.ndarray:
        return self._pictures([Image.fromarray(pixels) for pixels in shown])

    def texts(self, texts: list[str]) -> np.ndarray:
        longest = max(map(len, self._model.tokenizer(texts)["input_ids"]))
        some = max(1, PAIRS // max(1, longest) ** 2)
        instruction = self._preset.query_instruction
        parts = [texts[k : k + some] for k in range(0, len(texts), some)]
        return np.concatenate([self._embedded(part, instruction, "query") for part in parts])

    def _pictures(self, shown: list[Image.Image]) -> np.ndarray:
        return self._embedded(shown, self._preset.frame_instruction, "frame")

    def _embedded(self, inputs: list[Any], prompt: str, kind: str) -> np.ndarray:
        if self._preset.late is not None:
            return embedded_rows(self._model, inputs, prompt, kind)
        found = self._model.encode(
            inputs, prompt=prompt, batch_size=len(inputs), show_progress_bar=False
        )
        return np.asarray(found, dtype=np.float32)


def trained_encoder(preset: RetrieverConfig, precision: str, saved: Path) -> Encoder:
    """What `train.contrastive` saved. Errors are those of `load_trained`."""
    keep_freed_memory()
    return JointEncoder(load_trained(preset, precision, saved), preset)


def released_encoder(preset: RetrieverConfig, precision: str, folder: Path) -> Encoder:
    """What a preset names, as it was released; a base that is built from a seed stands in `folder`.

    Raises:
        UserError: a model is not on this machine and cannot be fetched, is not whole, or is none of
            the preset's kind.
    """
    keep_freed_memory()
    if preset.encoder == "vlm2vec":
        from evaluation.embedders.vlm2vec import load_vlm2vec

        return JointEncoder(load_vlm2vec(preset, precision), preset)
    if preset.encoder == "dual":
        from evaluation.embedders.dual_encoder import load_dual

        return load_dual(preset, precision)
    if preset.encoder == "languagebind":
        from evaluation.embedders.languagebind import load_languagebind

        return load_languagebind(preset, precision)
    return JointEncoder(load_retriever(preset, precision, [], folder), preset)
