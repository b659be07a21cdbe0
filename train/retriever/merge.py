"""Merge a retriever into its base."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch.nn.utils.rnn import pad_sequence

from conf.schema import ContrastiveCommand, LoraConfig
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
from train.common.merge import ModelOutputs, open_benchmark
from train.retriever.batches import split_queries

MAX_QUERIES = 64
"""Held-out queries that are compared, against the targets of all of them."""
BATCH = 8

Items = tuple[list[RetrievalQuery], FrameReader]


@dataclass(frozen=True)
class RetrieverMerge:
    """Compares embeddings of queries, relative to their size, and scores, relative to a query's
    score with itself, because scores may all be close to zero.

    Attributes:
        settings: Of the training run.
        saved: The folder of the trained adapters.
    """

    settings: ContrastiveCommand
    saved: Path
    max_difference = 0.1
    """Rounding to bf16 moves embeddings by 0.03 of their size where the adapters of a small
    retriever weigh as much as its base."""

    def held_out(self, root: Path, workers: int) -> Items:
        """Return queries that measured the run, and the frames of its benchmark."""
        settings, train = self.settings, self.settings.train
        store = open_benchmark(settings.benchmark, root, workers)
        _, queries = split_queries(
            store, train.batch, train.hard_negatives, train.validation_queries, settings.seed
        )
        return queries[:MAX_QUERIES], FrameReader(store, settings.retriever.image_size)

    def trained_outputs(self, items: Items) -> ModelOutputs:
        """Return the outputs of the adapters over their base."""
        settings = self.settings
        model = load_trained(settings.retriever, settings.train.precision, self.saved)
        # Some CPUs round 4-bit products differently once the weights are packed for inference.
        compat.keep_differentiable(model)
        return self._outputs(model, items)

    def write(self, folder: Path, format: str) -> None:
        """Write the merged model with weights in `format`, bf16 or fp32."""
        preset = self.settings.retriever
        base = replace(preset, lora=LoraConfig(rank=0))
        model = load_retriever(base, self.settings.train.precision, [], folder)
        model[0].model = loading.merge_adapters(
            model[0].model, self.saved, preset.quantization, format
        )
        load_head(model, self.saved)
        model.save_pretrained(str(folder), create_model_card=False)

    def merged_outputs(self, folder: Path, items: Items) -> ModelOutputs:
        """Return the outputs of the merged model in a folder."""
        return self._outputs(load_merged(folder, self.settings.retriever), items)

    def _outputs(self, model: Retriever, items: Items) -> ModelOutputs:
        preset, (queries, frames) = self.settings.retriever, items
        targets = list(dict.fromkeys(q.target for q in queries))
        rows, documents = (
            pad_sequence(embed(model, some, frames, preset, BATCH), batch_first=True)
            for some in (queries, targets)
        )
        scores = model.similarity(rows, documents)
        return ModelOutputs(
            values={"query": [rows], "score": [scores]},
            choices={"best_frame": scores.argmax(dim=1).tolist()},
            scales={"score": [model.similarity(rows, rows).diagonal()]},
        )
