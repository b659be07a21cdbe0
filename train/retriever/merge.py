"""Merges a retriever into its base."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torch.nn.utils.rnn import pad_sequence

from conf.schema import ContrastiveCommand, LoraConfig
from data.build import ensure_benchmark
from data.records import RetrievalQuery
from data.render.frame_cache import FrameReader
from models import compat, loading
from models.retriever.embedder import (
    Retriever,
    embed,
    load_head,
    load_merged,
    load_retriever,
    load_trained,
)
from train.common.merge import ModelOutputs, check_benchmark
from train.retriever.batches import split_queries

MAX_QUERIES = 64
"""Held-out queries that are compared, against the targets of all of them."""
BATCH = 8

Items = tuple[list[RetrievalQuery], FrameReader]


class RetrieverMerge:
    """Compares embeddings of queries, relative to their size, and scores, relative to a query's
    score with itself, because scores may all be close to zero."""

    product = "retriever"
    max_difference = 0.1
    """Rounding to bf16 moves embeddings by 0.03 of their size where the adapters of a small
    retriever weigh as much as its base."""

    def __init__(self, settings: ContrastiveCommand, saved: Path) -> None:
        self._settings, self._saved = settings, saved
        self._preset, self._precision = settings.retriever, settings.train.precision

    def held_out(self, store: Path, workers: int) -> Items:
        check_benchmark(store / self._settings.benchmark.name)
        opened = ensure_benchmark(self._settings.benchmark, store, workers)
        train = self._settings.train
        queries = split_queries(
            opened, train.batch, train.hard_negatives, train.validation_queries, self._settings.seed
        )[1]
        return queries[:MAX_QUERIES], FrameReader(opened, self._preset.image_size)

    def trained_outputs(self, items: Items) -> ModelOutputs:
        model = load_trained(self._preset, self._precision, self._saved)
        # Some CPUs round 4-bit products differently once the weights are packed for inference.
        compat.keep_differentiable(model)
        return self._outputs(model, items)

    def write(self, folder: Path, format: str) -> None:
        base = replace(self._preset, lora=LoraConfig(rank=0))
        model = load_retriever(base, self._precision, [], folder)
        model[0].model = loading.merge_adapters(
            model[0].model, self._saved, self._preset.quantization, format
        )
        load_head(model, self._saved)
        model.save_pretrained(str(folder), create_model_card=False)

    def merged_outputs(self, folder: Path, items: Items) -> ModelOutputs:
        return self._outputs(load_merged(folder, self._preset), items)

    def _outputs(self, model: Retriever, items: Items) -> ModelOutputs:
        queries, frames = items
        targets = list(dict.fromkeys(q.target for q in queries))
        rows, documents = (
            pad_sequence(embed(model, some, frames, self._preset, BATCH), batch_first=True)
            for some in (queries, targets)
        )
        scores = model.similarity(rows, documents)
        return ModelOutputs(
            values={"query": [rows], "score": [scores]},
            choices={"best_frame": scores.argmax(dim=1).tolist()},
            scales={"score": [model.similarity(rows, rows).diagonal()]},
        )
