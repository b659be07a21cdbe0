"""Embed queries and frames with a retriever and rank them, at each of its widths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sentence_transformers import SentenceTransformer
from tqdm import tqdm

from conf.errors import UserError
from conf.schema import RetrieverConfig
from data.frames import Frames
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from evaluation.metrics import rank_metrics
from evaluation.tables import RECALLS, RetrievalRow
from train.retriever import frame_input, query_input


def rank_all(
    model: SentenceTransformer,
    cfg: RetrieverConfig,
    store: Store,
    frames: Frames,
    batch: int,
    name: str,
) -> list[RetrievalRow]:
    """Rank the test database for every test query: a row a width, widest first. Scores are fp32
    cosines of the embeddings' first `width` entries.

    Raises:
        UserError: there is no test query.
    """
    queries, database = store.standard_test(), store.database("test")
    if not queries:
        raise UserError(f"{store.folder} has no queries of the standard test to measure on")
    asked = embed_queries(model, queries, frames, cfg, batch)
    shown = embed_frames(model, database, frames, cfg, batch)
    column = {frame: k for k, frame in enumerate(database)}
    gold = np.array([column[q.target] for q in queries])
    rows = []
    for width in cfg.widths:
        scores = normalise(asked[:, :width]) @ normalise(shown[:, :width]).T
        metrics = rank_metrics(scores, gold, RECALLS)
        rows.append(RetrievalRow.of(store.name, name, width, metrics, len(queries), len(database)))
    return rows


def embed_queries(
    model: SentenceTransformer,
    queries: Sequence[RetrievalQuery],
    frames: Frames,
    cfg: RetrieverConfig,
    batch: int,
) -> np.ndarray:
    """(queries, width) fp32 embeddings; pixels are read a batch at a time."""
    parts = []
    for start in tqdm(range(0, len(queries), batch), desc="embedding queries", unit="batch"):
        inputs = [query_input(q, frames, cfg) for q in queries[start : start + batch]]
        parts.append(_encode(model, inputs, cfg.query_instruction, batch))
    return np.concatenate(parts)


def embed_frames(
    model: SentenceTransformer,
    database: Sequence[FrameRef],
    frames: Frames,
    cfg: RetrieverConfig,
    batch: int,
) -> np.ndarray:
    """(frames, width) fp32 embeddings."""
    parts = []
    for start in tqdm(range(0, len(database), batch), desc="embedding frames", unit="batch"):
        inputs = [frame_input(f, frames) for f in database[start : start + batch]]
        parts.append(_encode(model, inputs, cfg.frame_instruction, batch))
    return np.concatenate(parts)


def _encode(model: SentenceTransformer, inputs: list, prompt: str, batch: int) -> np.ndarray:
    embedded = model.encode(inputs, prompt=prompt, batch_size=batch, show_progress_bar=False)
    return np.asarray(embedded, dtype=np.float32)


def normalise(embeddings: np.ndarray) -> np.ndarray:
    """Rows of unit length; a row of zeros stays one."""
    lengths = np.linalg.norm(embeddings, axis=1, keepdims=True)
    return embeddings / np.maximum(lengths, 1e-12)
