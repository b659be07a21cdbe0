"""Embed the queries, items and frames of a benchmark with a retriever, once, and what was written
or drawn of them.

What loads a model is imported only where something has to be embedded: importing it takes longer
than ranking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from PIL import Image

from conf.schema import RetrieverConfig
from data.records import FrameRef
from data.render.frame_cache import FrameReader, resize_frames
from data.store import Store
from evaluation.embedders.cache import EmbeddingCache
from evaluation.reporting.results import UNTRAINED
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

if TYPE_CHECKING:
    from evaluation.embedders.base import Encoder, Query

EMBEDDINGS = "embeddings"
"""Folder of them in a store."""
INPUTS = 2
"""Rises with what is shown, or told of a clip, so that no earlier embedding is taken for one."""
MAKERS = ("sentence-transformers", "transformers")
"""Packages that turn a prompt and pixels into a model's input."""

Thing = TypeVar("Thing")


@dataclass(frozen=True)
class Embedder:
    """A retriever that is measured: what tells its embeddings from all others, and how it is
    loaded."""

    name: str
    preset: RetrieverConfig
    precision: str
    weights: str
    """Hash of the base's weights and the adapters'."""
    processor: str
    """Hash of the files that make its input."""
    load: Callable[[], Encoder]

    def about(self, store: Store) -> dict[str, Any]:
        """Everything that an embedding depends on, besides what is shown and how it is asked."""
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
            "made by": {package: version(package) for package in MAKERS},
        }


def embedders(
    folder: Path | None, preset: RetrieverConfig, precision: str, store: Store, run: Path
) -> Iterator[Embedder]:
    """The retriever of a training run's `folder`, where there is one, and the untrained one that it
    began from: one at a time, so that only one needs room.

    Raises:
        UserError: what `trained_embedder` raises.
    """
    if folder is not None:
        yield trained_embedder(folder, preset, precision)
    if preset.architecture is not None:
        base = built_base(preset, precision, store, folder, run)
        preset = replace(preset, architecture=None, model=str(base))
    yield untrained_embedder(preset, precision, run)


def trained_embedder(folder: Path, preset: RetrieverConfig, precision: str) -> Embedder:
    """The retriever of a run of train.contrastive, or of an export.

    Raises:
        UserError: it is over another base than `preset` names, or saved by another pooling.
    """
    check_base(folder, preset)
    saved = product_folder(folder, "retriever")
    if preset.late is None:
        check_pooling(saved)

    @cache
    def load() -> Encoder:
        from evaluation.embedders.base import trained_encoder

        return trained_encoder(preset, precision, saved)

    digests = weights_digest(model_id(preset), saved), processor_digest(saved)
    return Embedder(run_title(folder), preset, precision, *digests, load)


def built_base(
    preset: RetrieverConfig, precision: str, store: Store, folder: Path | None, run: Path
) -> Path:
    """Where a base that is built from a seed is: in the training run that began from it, or else
    built here."""
    if folder is not None and (folder / "untrained").is_dir():
        return folder / "untrained"
    from models.retriever.embedder import load_retriever, tokenizer_texts

    load_retriever(
        preset, precision, tokenizer_texts(store.retrieval("train"), preset), run / "untrained"
    )
    return run / "untrained"


def untrained_embedder(preset: RetrieverConfig, precision: str, run: Path) -> Embedder:
    """The preset's base, or another model as it was released."""
    preset = pin_revisions(preset)

    @cache
    def load() -> Encoder:
        from evaluation.embedders.base import released_encoder

        return released_encoder(preset, precision, run / "untrained")

    base = model_id(preset)
    name = f"{UNTRAINED} {preset.name}" if preset.encoder == "qwen3_vl" else preset.name
    name += ", late" if preset.late is not None else ""
    digests = weights_digest(base, image_model_id(preset)), processor_digest(base)
    return Embedder(name, preset, precision, *digests, load)


def embed_queries(
    embedder: Embedder, queries: Sequence[Query], store: Store, frames: FrameReader, batch: int
) -> EmbeddingCache:
    """The embeddings of prefixes with their questions, by name; pixels are read a batch at
    a time.

    Raises:
        UserError: what `Embeddings.complete` and `check_widths` raise.
    """
    preset = embedder.preset
    about = {"instruction": preset.query_instruction, "frames": preset.frames}
    # Scene by scene, so that a scene's frames are decoded once.
    ordered = sorted(queries, key=lambda q: (q.scene_id, q.name))
    things = {q.name: q for q in ordered}
    return _embedded(
        embedder, "query", about, things, lambda e, some: e.queries(some, frames), store, batch
    )


def embed_frames(
    embedder: Embedder, database: Iterable[FrameRef], store: Store, frames: FrameReader, batch: int
) -> EmbeddingCache:
    """The embeddings of frames, by name. Errors are those of `embed_queries`."""
    about = {"instruction": embedder.preset.frame_instruction}
    ordered = sorted(database, key=lambda f: (f.scene_id, f.frame))
    things = {f.name: f for f in ordered}
    return _embedded(
        embedder, "frame", about, things, lambda e, some: e.frames(some, frames), store, batch
    )


def embed_texts(
    embedder: Embedder, texts: Iterable[str], store: Store, batch: int
) -> EmbeddingCache:
    """The embeddings of texts that stand for a query by themselves, by the text. Errors are those
    of `embed_queries`."""
    about = {"instruction": embedder.preset.query_instruction}
    # Those of one length together, so that few are padded; where memory runs out, it is at once.
    things = {text: text for text in sorted(set(texts), key=lambda text: (-len(text), text))}
    return _embedded(embedder, "text", about, things, lambda e, some: e.texts(some), store, batch)


def embed_images(
    embedder: Embedder, images: Mapping[str, Path], store: Store, batch: int
) -> EmbeddingCache:
    """The embeddings of images in files, by their names, made as those of frames are. Errors are
    those of `embed_queries`."""
    about = {"instruction": embedder.preset.frame_instruction}
    size = embedder.preset.image_size

    def encode(encoder: Encoder, some: list[Path]) -> np.ndarray:
        return encoder.drawn([image_pixels(path, size) for path in some])

    return _embedded(embedder, "image", about, dict(images), encode, store, batch)


def image_pixels(path: Path, size: int) -> np.ndarray:
    """(size, size, 3) uint8 of an image in a file, as a frame is shown."""
    with Image.open(path) as image:
        return resize_frames(np.array(image.convert("RGB"))[None], size)[0]


def _embedded(
    embedder: Embedder,
    kind: str,
    about: dict[str, Any],
    things: Mapping[str, Thing],
    encode: Callable[[Encoder, list[Thing]], np.ndarray],
    store: Store,
    batch: int,
) -> EmbeddingCache:
    preset = embedder.preset

    def embed(some: list[Thing]) -> np.ndarray:
        encoder = embedder.load()

        from models.memory import explain_out_of_memory

        when = f"where {len(some)} are embedded at once"
        with explain_out_of_memory(when, "lower batch, in a run of its own (run=NAME)"):
            rows = encode(encoder, some)
        if preset.late is None:
            check_widths(preset, rows.shape[1])
        return rows

    kept = EmbeddingCache(store.folder / EMBEDDINGS, kind, embedder.about(store) | about)
    kept.complete(things, embed, batch)
    if preset.late is None:
        check_widths(preset, kept.width)
    return kept
