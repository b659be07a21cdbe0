"""The columns of an exported benchmark (see `columns.yaml`), and the rows of its records.

Columns have the names of the records' fields. An export with images also contains, as PNGs, the
frames of prefixes, candidates, targets, hard negatives and databases.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from dynapix.conf.schema.benchmark import PAIRED
from dynapix.data.frames.frame_cache import FrameReader, encode_png
from dynapix.data.publish.leaderboard import write_question
from dynapix.data.records import (
    FrameRef,
    Rationale,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from dynapix.data.store import Store

if TYPE_CHECKING:
    import pyarrow as pa
    from datasets import Features

COLUMNS = OmegaConf.to_container(
    OmegaConf.create((files("dynapix.data.publish") / "columns.yaml").read_text())
)
DESCRIPTIONS: dict[str, str] = COLUMNS.pop("descriptions")
COLUMNS |= dict.fromkeys(PAIRED, COLUMNS["selection"])
LEADERBOARD = "leaderboard"
"""The table of `data.publish.leaderboard`."""
ENCODED_FRAMES = 1_000
"""Number of encoded frames that are kept in memory, at up to 100 KB each."""
ExportedRecord = SelectionItem | RetrievalQuery | FrameRef | Rationale


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


def arrow_schema(kind: str, images: bool) -> pa.Schema:
    """Return the schema of a table's parquet files. Its metadata tell `datasets` the columns, and
    pandas that integers stay integers where some are missing."""
    schema = dataset_features(images)[kind].arrow_schema
    columns = [
        {
            "name": name, "field_name": name, "pandas_type": "int64", "numpy_type": "Int64",
            "metadata": None,
        }
        for name, kind_of in list_columns(images)[kind].items()
        if kind_of == "int64"
    ]  # fmt: skip
    pandas = {"index_columns": [], "column_indexes": [], "columns": columns}
    return schema.with_metadata({**schema.metadata, b"pandas": json.dumps(pandas).encode()})


class RowBuilder:
    """Converts a store's records to rows, with images of their frames if `images` is set."""

    def __init__(self, store: Store, images: bool) -> None:
        self.images = images
        self._store, self._frames = store, FrameReader(store)
        config = store.manifest["config"]
        self._prefix_frames = config["prefix_frames"]
        self._negatives = config["retrieval"]["hard_negatives"]
        # Items of one scene share many frames, and encoding takes most of an export's time.
        self._encode = lru_cache(maxsize=ENCODED_FRAMES)(self._encode_png)

    def images_per_row(self, kind: str) -> int:
        """Return the maximum number of images in a row of a table."""
        if not self.images or kind == "rationales":
            return 0
        if kind == "database":
            return 1
        return self._prefix_frames + (self._negatives + 1 if kind == "retrieval" else 4)

    def row(self, record: ExportedRecord, kind: str, split: str) -> dict[str, Any]:
        """Return a record's values by column of the table `kind`. For a frame, `split` is the name
        of its database."""
        if kind == LEADERBOARD:
            return write_question(record, self._frames, self._prefix_frames)
        if isinstance(record, Rationale):
            row = asdict(record) | {"split": split}
            return {name: row[name] for name in COLUMNS["rationales"]}
        if isinstance(record, FrameRef):
            row = {**asdict(record), "database": split}
            return row | ({"image": self._encode(record)} if self.images else {})
        frames = sample_prefix_frames(record.prefix_start, record.prefix_stop, self._prefix_frames)
        fps = self._store.scene(record.scene_id).fps
        times = [frame / fps for frame in frames]
        row = asdict(record) | {"fps": fps, "prefix_frames": frames, "prefix_times": times}
        if not self.images:
            return row
        row["prefix_images"] = [self._encode(FrameRef(record.scene_id, f)) for f in frames]
        if isinstance(record, RetrievalQuery):
            row["target_image"] = self._encode(record.target)
            return row | {"hard_negative_images": [*map(self._encode, record.hard_negatives)]}
        references = (FrameRef(c.scene_id, c.frame) for c in record.candidates)
        return row | {"candidate_images": [*map(self._encode, references)]}

    def _encode_png(self, frame: FrameRef) -> dict[str, Any]:
        """Encode a frame in the form that `datasets.Image` stores."""
        png = encode_png(self._frames.image(frame.scene_id, frame.frame))
        return {"bytes": png, "path": f"{frame.scene_id}-{frame.frame:03d}.png"}
