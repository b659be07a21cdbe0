"""The columns of an exported benchmark (see `columns.yaml`), and the rows of its records.

Columns have the names of the records' fields. An export with images also contains, as PNGs, the
frames of prefixes, candidates, targets and databases. Hard negatives have no images.
"""

from __future__ import annotations

import io
from dataclasses import asdict
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from data.frames.frame_cache import FrameReader
from data.records import FrameRef, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.store import Store

if TYPE_CHECKING:
    from datasets import Features

COLUMNS = OmegaConf.to_container(
    OmegaConf.create((files("data.publish") / "columns.yaml").read_text())
)
DESCRIPTIONS: dict[str, str] = COLUMNS.pop("descriptions")
ENCODED_FRAMES = 1_000
"""Number of encoded frames that are kept in memory, at up to 100 KB each."""
ExportedRecord = SelectionItem | RetrievalQuery | FrameRef


def list_columns(images: bool) -> dict[str, dict[str, str]]:
    """Return the types of columns, as `columns.yaml` writes them, by configuration (table)."""
    return {
        name: {c: kind for c, kind in columns.items() if images or not kind.endswith("image")}
        for name, columns in COLUMNS.items()
    }


def dataset_features(images: bool) -> dict[str, Features]:
    """Return the `datasets.Features` of each configuration."""
    from datasets import Features, Image, List, Value

    frame = {"scene_id": Value("string"), "frame": Value("int64")}
    candidate = {**frame, "source": Value("string")}
    types = {"image": Image(), "frame": frame, "candidate": candidate}

    def feature(kind: str) -> Any:
        if kind.startswith("list of "):
            return List(feature(kind.removeprefix("list of ")))
        return types[kind] if kind in types else Value(kind)

    return {
        name: Features({column: feature(kind) for column, kind in columns.items()})
        for name, columns in list_columns(images).items()
    }


class RowBuilder:
    """Converts a store's records to rows, with images of their frames if `images` is set."""

    def __init__(self, store: Store, images: bool) -> None:
        self.images = images
        self._frames = FrameReader(store)
        self._prefix_frames = store.manifest["config"]["prefix_frames"]
        # Items of one scene share many frames, and encoding takes most of an export's time.
        self._encode = lru_cache(maxsize=ENCODED_FRAMES)(self._encode_png)

    def images_per_row(self, configuration: str) -> int:
        """Return the maximum number of images in a row of a configuration."""
        counts = {"selection": self._prefix_frames + 4, "retrieval": self._prefix_frames + 1}
        return counts.get(configuration, 1) if self.images else 0

    def row(self, record: ExportedRecord, split: str) -> dict[str, Any]:
        """Return a record's values by column. For a frame, `split` is the name of its database."""
        if isinstance(record, FrameRef):
            row = {**asdict(record), "database": split}
            return row | ({"image": self._encode(record)} if self.images else {})
        frames = sample_prefix_frames(record.prefix_start, record.prefix_stop, self._prefix_frames)
        row = asdict(record) | {"prefix_frames": frames}
        if not self.images:
            return row
        row["prefix_images"] = [self._encode(FrameRef(record.scene_id, f)) for f in frames]
        if isinstance(record, RetrievalQuery):
            return row | {"target_image": self._encode(record.target)}
        references = (FrameRef(c.scene_id, c.frame) for c in record.candidates)
        return row | {"candidate_images": list(map(self._encode, references))}

    def _encode_png(self, frame: FrameRef) -> dict[str, Any]:
        """Encode a frame in the form that `datasets.Image` stores."""
        png = io.BytesIO()
        self._frames.image(frame.scene_id, frame.frame).save(png, "PNG", compress_level=1)
        return {"bytes": png.getvalue(), "path": f"{frame.scene_id}-{frame.frame:03d}.png"}
