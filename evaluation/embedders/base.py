"""Embed the queries, items, frames, texts and images of a benchmark, with a cache on disk.

Modules that load a model are imported only when an embedding is missing, because importing them
takes longer than ranking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from PIL import Image

from conf.schema import RetrieverConfig
from data.records import FrameRef, RetrievalQuery, SelectionItem
from data.render.frame_cache import FrameReader, resize_frames
from data.store import Store
from evaluation.embedders.cache import EmbeddingCache
from evaluation.metrics.results import UNTRAINED
from models.fingerprints import (
    image_model_id,
    model_id,
    pin_revisions,
    processor_digest,
    weights_digest,
)
from models.resolved import check_base
from models.retriever.checks import check_pooling, check_widths
from models.trained_runs import product_folder, run_title

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
    """Returns fp32 embeddings (inputs, entries); frames are read at the preset's size."""

    def queries(self, queries: list[Query], frames: FrameReader) -> np.ndarray:
        """Embed prefixes with their questions."""

    def frames(self, refs: list[FrameRef], frames: FrameReader) -> np.ndarray: ...

    def images(self, images: list[np.ndarray]) -> np.ndarray:
        """Embed (S, S, 3) uint8 pixels as frames."""

    def texts(self, texts: list[str]) -> np.ndarray:
        """Embed texts as queries without a prefix."""


@dataclass(frozen=True)
class Embedder:
    """A measured retriever: what identifies its embeddings, and how its encoder is loaded.

    Attributes:
        weights: Digest of the base's weights and the adapters'.
        processor: Digest of the files that define its input.
    """

    name: str
    preset: RetrieverConfig
    precision: str
    weights: str
    processor: str
    load: Callable[[], Encoder]

    def settings(self, store: Store) -> dict[str, Any]:
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
            "benchmark": store.identity,
            "made by": {package: version(package) for package in PACKAGES},
        }


def open_embedders(
    folder: Path | None, preset: RetrieverConfig, precision: str, store: Store, run: Path
) -> Iterator[Embedder]:
    """Yield the retriever of a run's `folder`, if there is one, and then its untrained base.

    They come one at a time, so that memory holds one.

    Raises:
        UserError: What `trained_embedder` raises.
    """
    if folder is not None:
        yield trained_embedder(folder, preset, precision)
    if preset.architecture is not None:
        base = built_base(preset, precision, store, folder, run)
        preset = replace(preset, architecture=None, model=str(base))
    yield untrained_embedder(preset, precision, run)


def trained_embedder(folder: Path, preset: RetrieverConfig, precision: str) -> Embedder:
    """Return the retriever of a run of train.contrastive or of an export.

    Raises:
        UserError: Its base is not the one that `preset` names, or its pooling differs.
    """
    check_base(folder, preset)
    saved = product_folder(folder, "retriever")
    if preset.late is None:
        check_pooling(saved)

    @cache
    def load() -> Encoder:
        from evaluation.embedders.joint_encoder import trained_encoder

        return trained_encoder(preset, precision, saved)

    digests = weights_digest(model_id(preset), saved), processor_digest(saved)
    return Embedder(run_title(folder), preset, precision, *digests, load)


def built_base(
    preset: RetrieverConfig, precision: str, store: Store, folder: Path | None, run: Path
) -> Path:
    """Return the folder of a base that is built from a seed: the training run's, or a new one."""
    if folder is not None and (folder / "untrained").is_dir():
        return folder / "untrained"
    from models.retriever.embedder import load_retriever, tokenizer_texts

    texts = tokenizer_texts(store.retrieval("train"), preset)
    load_retriever(preset, precision, texts, run / "untrained")
    return run / "untrained"


def untrained_embedder(preset: RetrieverConfig, precision: str, run: Path) -> Embedder:
    """Return the preset's model as it was released."""
    preset = pin_revisions(preset)

    @cache
    def load() -> Encoder:
        from evaluation.embedders.joint_encoder import released_encoder

        return released_encoder(preset, precision, run / "untrained")

    base = model_id(preset)
    name = f"{UNTRAINED} {preset.name}" if preset.encoder == "qwen3_vl" else preset.name
    name += ", late" if preset.late is not None else ""
    digests = weights_digest(base, image_model_id(preset)), processor_digest(base)
    return Embedder(name, preset, precision, *digests, load)


def embed_queries(
    embedder: Embedder, queries: Sequence[Query], store: Store, frames: FrameReader, batch: int
) -> EmbeddingCache:
    """Embed prefixes with their questions, by name; pixels are read one batch at a time.

    Raises:
        UserError: Memory runs out, an embedding is non-finite or narrower than the widths, or
            another process fills the cache.
    """
    preset = embedder.preset
    # By scene, so that each scene's frames are decoded once.
    inputs = {q.name: q for q in sorted(queries, key=lambda q: (q.scene_id, q.name))}
    settings = {"instruction": preset.query_instruction, "frames": preset.frames}
    return _embed(
        embedder, "query", settings, inputs, lambda e, some: e.queries(some, frames), store, batch
    )


def embed_frames(
    embedder: Embedder, database: Iterable[FrameRef], store: Store, frames: FrameReader, batch: int
) -> EmbeddingCache:
    """Embed frames, by name. Errors are those of `embed_queries`."""
    inputs = {f.name: f for f in sorted(database, key=lambda f: (f.scene_id, f.frame))}
    settings = {"instruction": embedder.preset.frame_instruction}
    return _embed(
        embedder, "frame", settings, inputs, lambda e, some: e.frames(some, frames), store, batch
    )


def embed_texts(
    embedder: Embedder, texts: Iterable[str], store: Store, batch: int
) -> EmbeddingCache:
    """Embed texts as queries without a prefix, by the text. Errors are those of `embed_queries`."""
    # Longest first: little padding in a batch, and a lack of memory shows at once.
    inputs = {text: text for text in sorted(set(texts), key=lambda text: (-len(text), text))}
    settings = {"instruction": embedder.preset.query_instruction}
    return _embed(embedder, "text", settings, inputs, lambda e, some: e.texts(some), store, batch)


def embed_images(
    embedder: Embedder, images: Mapping[str, Path], store: Store, batch: int
) -> EmbeddingCache:
    """Embed image files as frames, by their names. Errors are those of `embed_queries`."""

    def encode(encoder: Encoder, some: list[Path]) -> np.ndarray:
        return encoder.images([read_image(path, embedder.preset.image_size) for path in some])

    settings = {"instruction": embedder.preset.frame_instruction}
    return _embed(embedder, "image", settings, dict(images), encode, store, batch)


def read_image(path: Path, size: int) -> np.ndarray:
    """Return an image file's pixels (size, size, 3) uint8, resized as frames are."""
    with Image.open(path) as image:
        return resize_frames(np.array(image.convert("RGB"))[None], size)[0]


def _embed(
    embedder: Embedder,
    kind: str,
    settings: dict[str, Any],
    inputs: Mapping[str, Input],
    encode: Callable[[Encoder, list[Input]], np.ndarray],
    store: Store,
    batch: int,
) -> EmbeddingCache:
    preset = embedder.preset

    def embed(some: list[Input]) -> np.ndarray:
        encoder = embedder.load()

        from models.memory import explain_out_of_memory

        with explain_out_of_memory(
            f"with {len(some)} inputs in a batch", "lower batch, in a separate run (run=NAME)"
        ):
            rows = encode(encoder, some)
        if preset.late is None:
            check_widths(preset, rows.shape[1])
        return rows

    embeddings = EmbeddingCache(
        store.folder / EMBEDDINGS, kind, embedder.settings(store) | settings
    )
    embeddings.complete(inputs, embed, batch)
    if preset.late is None:
        check_widths(preset, embeddings.width)
    return embeddings
