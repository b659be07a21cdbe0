"""Embed the queries and the frames of a benchmark with a retriever, once.

What loads a model is imported only where something has to be embedded: importing it takes longer
than ranking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from conf.schema import RetrieverConfig
from data.frames import Frames
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from evaluation.cache import Embeddings
from evaluation.tables import UNTRAINED
from train.compatible import (
    check_base,
    check_pooling,
    check_widths,
    processor_digest,
    weights_digest,
)
from train.trained import product_folder, run_title

if TYPE_CHECKING:
    from train.retriever import Retriever

EMBEDDINGS = "embeddings"
"""Folder of them in a store."""
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
    load: Callable[[], Retriever]

    def about(self, store: Store) -> dict[str, Any]:
        """Everything that an embedding depends on, besides what is shown and how it is asked."""
        preset = self.preset
        return {
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
    check_base(folder, preset.model)
    saved = product_folder(folder, "retriever")
    if preset.late is None:
        check_pooling(saved)

    @cache
    def load() -> Retriever:
        from train.retriever import load_trained
        from train.room import keep_big_blocks

        keep_big_blocks()
        return load_trained(preset, precision, saved)

    digests = weights_digest(preset.model, saved), processor_digest(saved)
    return Embedder(run_title(folder), preset, precision, *digests, load)


def built_base(
    preset: RetrieverConfig, precision: str, store: Store, folder: Path | None, run: Path
) -> Path:
    """Where a base that is built from a seed is: in the training run that began from it, or else
    built here."""
    if folder is not None and (folder / "untrained").is_dir():
        return folder / "untrained"
    from train.retriever import corpus, load_retriever

    load_retriever(preset, precision, corpus(store.retrieval("train"), preset), run / "untrained")
    return run / "untrained"


def untrained_embedder(preset: RetrieverConfig, precision: str, run: Path) -> Embedder:
    """The preset's base."""

    @cache
    def load() -> Retriever:
        from train.retriever import load_retriever
        from train.room import keep_big_blocks

        keep_big_blocks()
        return load_retriever(preset, precision, [], run / "untrained")

    digests = weights_digest(preset.model), processor_digest(preset.model)
    name = f"{UNTRAINED} {preset.name}" + (", late" if preset.late is not None else "")
    return Embedder(name, preset, precision, *digests, load)


def frame_name(frame: FrameRef) -> str:
    return f"{frame.scene_id}/{frame.frame}"


def embed_queries(
    embedder: Embedder, queries: Sequence[RetrievalQuery], store: Store, frames: Frames, batch: int
) -> Embeddings:
    """The embeddings of queries, by their ids; pixels are read a batch at a time.

    Raises:
        UserError: what `Embeddings.complete` and `check_widths` raise.
    """
    preset = embedder.preset

    def inputs(some: list[RetrievalQuery]) -> list:
        from train.retriever import query_input

        return [query_input(q, frames, preset) for q in some]

    about = {"instruction": preset.query_instruction, "frames": preset.frames}
    # Scene by scene, so that a scene's frames are decoded once.
    things = {q.query_id: q for q in sorted(queries, key=lambda q: (q.scene_id, q.query_id))}
    return _embedded(embedder, "query", about, things, inputs, store, batch)


def embed_frames(
    embedder: Embedder, database: Sequence[FrameRef], store: Store, frames: Frames, batch: int
) -> Embeddings:
    """The embeddings of frames, by `frame_name`. Errors are those of `embed_queries`."""

    def inputs(some: list[FrameRef]) -> list:
        from train.retriever import frame_input

        return [frame_input(f, frames) for f in some]

    about = {"instruction": embedder.preset.frame_instruction}
    ordered = sorted(database, key=lambda f: (f.scene_id, f.frame))
    things = {frame_name(f): f for f in ordered}
    return _embedded(embedder, "frame", about, things, inputs, store, batch)


def _embedded(
    embedder: Embedder,
    kind: str,
    about: dict[str, Any],
    things: Mapping[str, Thing],
    inputs: Callable[[list[Thing]], list],
    store: Store,
    batch: int,
) -> Embeddings:
    preset = embedder.preset

    def embed(some: list[Thing]) -> np.ndarray:
        model = embedder.load()
        shown, prompt = inputs(some), about["instruction"]
        if preset.late is not None:
            from evaluation.late import embedded_rows

            return embedded_rows(model, shown, prompt, kind)
        check_widths(preset, model.get_embedding_dimension())
        embedded = model.encode(shown, prompt=prompt, batch_size=batch, show_progress_bar=False)
        return np.asarray(embedded, dtype=np.float32)

    kept = Embeddings(store.folder / EMBEDDINGS, kind, embedder.about(store) | about)
    kept.complete(things, embed, batch)
    if preset.late is None:
        check_widths(preset, kept.width)
    return kept
