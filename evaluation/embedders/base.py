"""Embed the queries, items, frames and texts of a benchmark, with a cache on disk.

Modules that load a model are imported only when an embedding is missing, because importing them
takes longer than ranking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from conf.runs import Run
from conf.schema import ContrastiveCommand, EmbedderConfig, RetrieverConfig
from conf.schema.evaluation import EmbeddingCommand
from data.build import ensure_benchmark
from data.records import FrameRef, RetrievalQuery, SelectionItem
from data.render.frame_cache import FrameReader
from data.store import Store
from evaluation.embedders.cache import EmbeddingCache
from evaluation.metrics.results import UNTRAINED
from models.checks import check_modules, check_widths
from models.fingerprints import model_id, pin_revisions, processor_digest, weights_digest
from models.precision import resolve_precision
from models.resolved import check_base
from models.trained_runs import product_folder, resolve_model, run_title

EMBEDDINGS = "embeddings"
"""Their folder in a store."""
INPUTS = 2
"""Version of the inputs' layout; raise it when the layout changes, so that earlier embeddings are
not reused."""
PACKAGES = ("sentence-transformers", "transformers")
"""Packages that turn a prompt and pixels into a model's input."""

Query = RetrievalQuery | SelectionItem
Input = TypeVar("Input")


class Encoder(Protocol):
    """A loaded model that returns fp32 embeddings (inputs, entries)."""

    def queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        """Embed prefixes with their questions."""

    def frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray: ...

    def texts(self, texts: list[str]) -> np.ndarray:
        """Embed texts as queries without a prefix."""


@dataclass(frozen=True)
class Embedder:
    """A retriever that is evaluated. Its encoder is loaded when the first embedding is missing.

    Its methods embed the inputs that the store's cache lacks, `batch` at a time. They raise
    UserError if memory runs out, or if an embedding is non-finite or narrower than the widths.

    Attributes:
        saved: Folder of the trained retriever; None for the preset's model as it was released.
        weights: Digest of the base's weights and the adapters'.
        processor: Digest of the files that define its input.
        frames: Reads the pixels of the store's frames at the preset's size.
    """

    name: str
    preset: RetrieverConfig
    precision: str
    saved: Path | None
    weights: str
    processor: str
    store: Store
    frames: FrameReader
    batch: int

    @cached_property
    def encoder(self) -> Encoder:
        from evaluation.embedders.joint_encoder import load_encoder

        return load_encoder(self.preset, self.precision, self.saved)

    def embed_queries(self, queries: Sequence[Query]) -> EmbeddingCache:
        """Embed prefixes with their questions, by name; pixels are read one batch at a time."""
        # By scene, so that each scene's frames are decoded once.
        inputs = {q.name: q for q in sorted(queries, key=lambda q: (q.scene_id, q.name))}
        preset = self.preset
        settings = {"instruction": preset.query_instruction, "frames": preset.frames}
        return self._embed("query", settings, inputs, lambda e, some: e.queries(some, self.frames))

    def embed_frames(self, database: Iterable[FrameRef]) -> EmbeddingCache:
        """Embed frames, by name."""
        inputs = {f.name: f for f in sorted(database, key=lambda f: (f.scene_id, f.frame))}
        settings = {"instruction": self.preset.frame_instruction}
        return self._embed("frame", settings, inputs, lambda e, some: e.frames(some, self.frames))

    def embed_texts(self, texts: Iterable[str]) -> EmbeddingCache:
        """Embed texts as queries without a prefix, by the text."""
        # Longest first: little padding in a batch, and a lack of memory shows at once.
        inputs = {text: text for text in sorted(set(texts), key=lambda text: (-len(text), text))}
        settings = {"instruction": self.preset.query_instruction}
        return self._embed("text", settings, inputs, lambda e, some: e.texts(some))

    def _embed(
        self,
        kind: str,
        settings: dict[str, Any],
        inputs: Mapping[str, Input],
        encode: Callable[[Encoder, list[Input]], np.ndarray],
    ) -> EmbeddingCache:
        def embed(some: list[Input]) -> np.ndarray:
            encoder = self.encoder

            from models.memory import explain_out_of_memory

            with explain_out_of_memory(
                f"with {len(some)} inputs in a batch", "lower batch, in a separate run (run=NAME)"
            ):
                rows = encode(encoder, some)
            self._check_widths(rows.shape[1])
            return rows

        folder = self.store.folder / EMBEDDINGS
        embeddings = EmbeddingCache(folder, kind, self.settings() | settings)
        embeddings.complete(inputs, embed, self.batch)
        self._check_widths(embeddings.width)
        return embeddings

    def _check_widths(self, entries: int) -> None:
        if self.preset.late is None:
            check_widths(self.preset, entries)

    def settings(self) -> dict[str, Any]:
        """Return everything that an embedding depends on, except its input and instruction."""
        preset = self.preset
        return {
            "encoder": preset.encoder,
            "inputs": INPUTS,
            "weights": self.weights,
            "processor": self.processor,
            "revision": preset.revision,
            "quantization": preset.quantization,
            "precision": self.precision,
            "image_size": preset.image_size,
            "late": None if preset.late is None else asdict(preset.late),
            "benchmark": self.store.identity,
            "made by": {package: version(package) for package in PACKAGES},
        }


def open_retriever(
    cfg: EmbeddingCommand, run: Run
) -> tuple[RetrieverConfig, Store, Iterator[Embedder]]:
    """Return the retriever's preset, the benchmark's store and the embedders of `open_embedders`.

    Raises:
        UserError: The model cannot be used on this benchmark, or the benchmark cannot be built.
    """
    folder, trained = resolve_model(
        cfg, cfg.benchmark, ContrastiveCommand, "retriever", run.overrides
    )
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    embedders = open_embedders(folder, trained, store, run.folder, cfg.batch)
    return trained.retriever, store, embedders


def open_embedders(
    folder: Path | None,
    trained: ContrastiveCommand | EmbedderConfig,
    store: Store,
    run: Path,
    batch: int,
) -> Iterator[Embedder]:
    """Yield the retriever of a run's `folder`, if there is one, and then its untrained base: one at
    a time, so that memory holds only one.

    Args:
        trained: The settings of that run, or those of the command.
        run: Folder of the evaluation, for a base that is built from a seed.

    Raises:
        UserError: The trained retriever's base is not the one that its preset names, or its pooling
            differs.
    """
    preset, precision = trained.retriever, resolve_precision(trained.train.precision)
    inputs = store, FrameReader(store, preset.image_size), batch
    if folder is not None:
        check_base(folder, preset)
        saved = product_folder(folder, "retriever")
        if preset.late is None:
            check_modules(saved)
        digests = (
            weights_digest(model_id(preset.model, preset.revision), saved),
            processor_digest(saved),
        )
        yield Embedder(run_title(folder), preset, precision, saved, *digests, *inputs)
    if preset.architecture is not None:
        # The base is built from a seed; a training run contains it.
        base = (folder or run) / "untrained"
        if folder is None or not base.is_dir():
            from models.retriever.embedder import load_retriever, tokenizer_texts

            base = run / "untrained"
            texts = tokenizer_texts(store.retrieval("train"), preset)
            load_retriever(preset, precision, texts, base)
        preset = replace(preset, architecture=None, model=str(base))
    preset = pin_revisions(preset)
    name = f"{UNTRAINED} {preset.name}" if preset.encoder == "qwen3_vl" else preset.name
    name += ", late" if preset.late is not None else ""
    source = model_id(preset.model, preset.revision)
    image_source = model_id(preset.image_model, preset.image_revision)
    digests = weights_digest(source, image_source), processor_digest(source)
    yield Embedder(name, preset, precision, None, *digests, *inputs)
