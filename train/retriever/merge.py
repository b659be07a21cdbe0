"""Merge the adapters of a trained retriever into its base."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch.nn.utils.rnn import pad_sequence

from dynapix.conf.schema import ContrastiveCommand, LoraConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.models import compat, loading
from dynapix.models.retriever.embedder import load_head, load_merged, load_retriever, load_trained
from dynapix.models.retriever.inputs import Retriever, embed
from dynapix.train.common.output_comparison import ModelOutputs, require_benchmark
from dynapix.train.retriever.batches import split_queries

MAX_QUERIES = 64
"""Maximum number of held-out queries. Each is scored against the targets of all these queries."""
BATCH = 8
"""Number of queries or frames that are embedded at a time."""

HeldOut = tuple[list[RetrievalQuery], FrameReader]


@dataclass(frozen=True)
class RetrieverMerge:
    """Merges a retriever, and computes its outputs before and after.

    Differences of scores are relative to the scores of the queries with themselves, because all
    scores of frames may be close to zero.

    Attributes:
        settings: The settings of the training run.
        saved: The folder of the trained adapters.
    """

    settings: ContrastiveCommand
    saved: Path
    max_difference = 0.1
    """Largest accepted relative difference. Rounding to bf16 causes up to 0.03 in small retrievers
    whose adapters contribute as much to the outputs as their base."""

    def held_out(self, root: Path, workers: int) -> HeldOut:
        """Return some validation queries of the run, and a reader of the benchmark's frames."""
        settings = self.settings
        store = require_benchmark(settings.benchmark, root, workers)
        _, queries = split_queries(store, settings.train, settings.seed)
        return queries[:MAX_QUERIES], FrameReader(store, settings.retriever.image_size)

    def trained_outputs(self, items: HeldOut) -> ModelOutputs:
        """Return the outputs of the trained retriever, the adapters over their base."""
        settings = self.settings
        model = load_trained(settings.retriever, settings.train.precision, self.saved)
        # Prevent a CPU from repacking 4-bit weights for inference, which changes the rounding.
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

    def merged_outputs(self, folder: Path, items: HeldOut) -> ModelOutputs:
        """Return the outputs of the merged retriever in a folder."""
        return self._outputs(load_merged(folder, self.settings.retriever), items)

    def _outputs(self, model: Retriever, items: HeldOut) -> ModelOutputs:
        preset, (queries, frames) = self.settings.retriever, items
        targets = list(dict.fromkeys(q.target for q in queries))
        embedded, documents = (
            pad_sequence(embed(model, inputs, frames, preset, BATCH), batch_first=True)
            for inputs in (queries, targets)
        )
        scores = model.similarity(embedded, documents)
        return ModelOutputs(
            values={"query": [embedded], "score": [scores]},
            choices={"best_frame": scores.argmax(dim=1).tolist()},
            scales={"score": [model.similarity(embedded, embedded).diagonal()]},
        )
