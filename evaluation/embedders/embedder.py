"""Embed the queries, selection items, frames and texts of a benchmark, with a cache on disk.

Modules that load a model are imported only when an embedding is missing, because importing them
takes longer than ranking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dynapix.conf.runs import Run, rank
from dynapix.conf.schema import ContrastiveCommand, EmbedderConfig, RetrieverConfig
from dynapix.conf.schema.evaluation import EmbeddingCommand
from dynapix.data.build import ensure_benchmark
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FrameRef
from dynapix.data.store import Store
from dynapix.evaluation.embedders.cache import EmbeddingCache
from dynapix.evaluation.metrics.results import UNTRAINED
from dynapix.models.checks import check_widths
from dynapix.models.distributed import main_first
from dynapix.models.fingerprints import model_id, pin_revisions, processor_digest, weights_digest
from dynapix.models.resolved_settings import check_base, resolve_precision
from dynapix.models.trained_runs import product_folder, resolve_model, run_title

if TYPE_CHECKING:
    from dynapix.evaluation.embedders.joint_encoder import Encoder
    from dynapix.models.retriever.inputs import Query

EMBEDDINGS = "embeddings"
"""Folder of the embeddings in a store."""
INPUT_VERSION = 3
"""Version of the layout of the models' inputs. Increment it when the layout changes, so that
earlier embeddings are not reused."""
PACKAGES = ("sentence-transformers", "transformers")
"""Packages that turn a prompt and pixels into a model's input, which depends on their versions."""

Input = TypeVar("Input")


@dataclass(frozen=True)
class Embedder:
    """A retriever that is evaluated. Its encoder is loaded when an embedding is missing.

    The `embed_` methods embed the inputs that the store's cache lacks, `batch` at a time, and
    return the cache, from which only the main rank can read. They raise UserError if memory runs
    out, or if an embedding is non-finite or has fewer entries than the widest width.

    Attributes:
        saved: Folder of the trained retriever; None for the preset's model as it was released.
        weights: Digest of the weights, including adapters.
        processor: Digest of the files of the tokenizer and the processor.
        frames: Reads the frames of the store, resized to the preset's `image_size`.
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
        from dynapix.evaluation.embedders.joint_encoder import load_encoder

        return load_encoder(self.preset, self.precision, self.saved)

    def try_out(self, frame: FrameRef | None) -> None:
        """Embed a text and, unless it is None, a frame, and release the encoder.

        Raises:
            UserError: The encoder cannot be loaded, or cannot embed one of them.
        """
        self.encoder.embed_texts(["A frame."])
        if frame is not None:
            self.encoder.embed_frames([frame], self.frames)
        self.__dict__.pop("encoder")

    def embed_queries(self, queries: Sequence[Query]) -> EmbeddingCache:
        """Embed prefixes with their questions. The cache stores them by `Query.name`."""
        # By scene, so that each scene's frames are decoded once.
        inputs = {q.name: q for q in sorted(queries, key=lambda q: (q.scene_id, q.name))}
        preset = self.preset
        settings = {"instruction": preset.query_instruction, "frames": preset.frames}
        return self._embed(
            "query", settings, inputs, lambda model, batch: model.embed_queries(batch, self.frames)
        )

    def embed_frames(self, database: Iterable[FrameRef]) -> EmbeddingCache:
        """Embed frames. The cache stores them by `FrameRef.name`."""
        inputs = {f.name: f for f in sorted(database, key=lambda f: (f.scene_id, f.frame))}
        settings = {"instruction": self.preset.frame_instruction}
        return self._embed(
            "frame", settings, inputs, lambda model, batch: model.embed_frames(batch, self.frames)
        )

    def embed_texts(self, texts: Iterable[str]) -> EmbeddingCache:
        """Embed texts as queries without a prefix. The cache stores them by the text itself."""
        # Longest first: a batch has little padding, and a lack of memory shows in the first batch.
        inputs = {text: text for text in sorted(set(texts), key=lambda text: (-len(text), text))}
        settings = {"instruction": self.preset.query_instruction}
        return self._embed("text", settings, inputs, lambda model, batch: model.embed_texts(batch))

    def _embed(
        self,
        kind: str,
        settings: dict[str, Any],
        inputs: Mapping[str, Input],
        encode: Callable[[Encoder, list[Input]], np.ndarray],
    ) -> EmbeddingCache:
        def embed(batch: list[Input]) -> np.ndarray:
            encoder = self.encoder

            from dynapix.models.memory import explain_out_of_memory

            with explain_out_of_memory(
                f"with {len(batch)} inputs in a batch",
                "run the same command with a lower batch, which goes on after the finished inputs",
            ):
                rows = encode(encoder, batch)
            self._check_widths(rows.shape[1])
            return rows

        folder = self.store.folder / EMBEDDINGS
        embeddings = EmbeddingCache(folder, kind, self.settings() | settings)
        embeddings.complete(inputs, embed, self.batch)
        if rank() == 0:
            self._check_widths(embeddings.width)
        return embeddings

    def _check_widths(self, entries: int) -> None:
        if self.preset.late is None:
            check_widths(self.preset, entries)

    def settings(self) -> dict[str, Any]:
        """Return everything that an embedding depends on, except its input and the settings of that
        kind of input, such as the instruction."""
        preset = self.preset
        return {
            "encoder": preset.encoder,
            "inputs": INPUT_VERSION,
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
    with main_first():
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
    """Yield the retriever of the run in `folder`, if there is one, and then its untrained base, one
    at a time, so that memory holds only one of them.

    Args:
        trained: The settings of that run; without a folder, those of the command.
        run: Folder of the evaluation. A base that is built from a seed is saved there.

    Raises:
        UserError: The weights of a trained retriever's local base have changed since the training.
    """
    preset, precision = trained.retriever, resolve_precision(trained.train.precision)
    inputs = store, FrameReader(store, preset.image_size), batch
    if folder is not None:
        check_base(folder, preset)
        saved = product_folder(folder, "retriever")
        digests = (
            weights_digest(model_id(preset.model, preset.revision), saved),
            processor_digest(saved),
        )
        yield Embedder(run_title(folder), preset, precision, saved, *digests, *inputs)
    if preset.architecture is not None:
        # The base is built from a seed. A training run contains it.
        base = (folder or run) / "untrained"
        if folder is None or not base.is_dir():
            from dynapix.models.retriever.embedder import load_retriever, tokenizer_texts

            base = run / "untrained"
            texts = tokenizer_texts(store.retrieval("train"), preset)
            load_retriever(preset, precision, texts, base)
        preset = replace(preset, architecture=None, model=str(base))
    preset = pin_revisions(preset)
    released = preset.encoder in ("vlm2vec", "dual", "languagebind")
    name = preset.name if released else f"{UNTRAINED} {preset.name}"
    name += ", late" if preset.late is not None else ""
    source = model_id(preset.model, preset.revision)
    image_source = model_id(preset.image_model, preset.image_revision)
    digests = weights_digest(source, image_source), processor_digest(source)
    yield Embedder(name, preset, precision, None, *digests, *inputs)
