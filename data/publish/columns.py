"""The columns of an exported benchmark: their types, their descriptions, and a record's row.

Columns have the names of the records' fields. With images, frames follow their references as
encoded PNGs.
"""

from __future__ import annotations

import io
from dataclasses import asdict
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from data.records import FrameRef, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store

if TYPE_CHECKING:
    from datasets import Features

CONFIGURATIONS = ("selection", "retrieval", "database")
ENCODED_FRAMES = 1_000
"""Encoded frames kept in memory, at up to 100 KB each."""
DESCRIPTIONS = {
    "item_id": "Name of the item.",
    "query_id": "Name of the query.",
    "split": "train or test. A scene is in one split, in every track.",
    "suite": "dynapix; the simulator of a transfer suite (with the prefix standin_ if Bullet "
    "simulated the scenes); or matched_anchor for pairs of items that differ only in their "
    "question's anchor.",
    "family": "Event, time or window: what fixes the target's moment.",
    "subtype": "The construction cell inside the family.",
    "framing": "Event family: future (the prefix ends before the collision) or contact (at it).",
    "distractors": "Source of the distractors.",
    "gap": "Event family: frames from the end of the prefix to the target.",
    "horizon": "Time and window families: frames from the end of the prefix to the target.",
    "group": "Window family: future events, from G1 (none) to G4 (several).",
    "window_family": "Window family: built around the whole scene (A), a colliding pair (B) or the "
    "object that moves most (C).",
    "difficulty": "Window family: hard (the distractors nearest to the target) or easy (far ones).",
    "pool": "future, or counterfactual (the scene without one of its objects).",
    "builder": "1 to 6 for the future pool, null for the counterfactual pool.",
    "anchor": "What the question refers to: a time, an event or an intervention.",
    "question": "The question in the model's prompt.",
    "scene_id": "The scene, one simulated video.",
    "prefix_start": "First frame of the prefix.",
    "prefix_stop": "Last frame of the prefix, inclusive.",
    "prefix_frames": "The frames of the prefix that are input to a model, evenly spread.",
    "prefix_images": "The images of prefix_frames, in order of time.",
    "target_frame": "The target, a frame of the item's own scene.",
    "event_frame": "Event family: the first frame at or after the contact.",
    "candidates": "Four frames in a seeded order, one of them the target.",
    "candidate_images": "The images of candidates, in the same order.",
    "answer": "Position of the target among the candidates, 0 to 3.",
    "min_displacement": "Least displacement between two candidates, in px at 336 x 336.",
    "removed_object": "Counterfactual pool: noun phrase of the absent object.",
    "standard": "Whether the query belongs to the standard test, over the database test.",
    "target": "The frame that answers the query.",
    "target_image": "The image of target.",
    "hard_negatives": "Wrong-time frames that resemble the target.",
    "database": "Name of the database: test (for the standard test), future (the source of the "
    "future pool, which contains test) or counterfactual (the source of that pool).",
    "frame": "Index of the frame in its scene, from 0.",
    "source": "target, or the source of the distractor.",
    "image": "The image of the frame.",
}


def dataset_features(images: bool) -> dict[str, Features]:
    """Return the columns of each configuration, in order."""
    from datasets import Features, Image, List, Value

    text, integer = Value("string"), Value("int64")
    frame = {"scene_id": text, "frame": integer}
    prefix = {
        "scene_id": text,
        "prefix_start": integer,
        "prefix_stop": integer,
        "prefix_frames": List(integer),
        "prefix_images": List(Image()),
    }
    selection = {
        **dict.fromkeys(("item_id", "split", "suite", "family", "subtype"), text),
        **dict.fromkeys(("framing", "distractors"), text),
        **dict.fromkeys(("gap", "horizon"), integer),
        **dict.fromkeys(("group", "window_family", "difficulty", "question"), text),
        **prefix,
        **dict.fromkeys(("target_frame", "event_frame"), integer),
        "candidates": List({**frame, "source": text}),
        "candidate_images": List(Image()),
        "answer": integer,
        "min_displacement": Value("float64"),
    }
    retrieval = {
        **dict.fromkeys(("query_id", "split", "pool"), text),
        "builder": integer,
        **dict.fromkeys(("anchor", "question"), text),
        **prefix,
        "removed_object": text,
        "standard": Value("bool"),
        "target": frame,
        "target_image": Image(),
        "hard_negatives": List(frame),
    }
    database = {"database": text, **frame, "image": Image()}
    if not images:
        for columns in (selection, retrieval, database):
            for name in [n for n in columns if n.endswith(("image", "images"))]:
                del columns[name]
    tables = zip(CONFIGURATIONS, (selection, retrieval, database), strict=True)
    return {name: Features(columns) for name, columns in tables}


class RowBuilder:
    """Turns a store's records into rows, with their frames if `images` is set."""

    def __init__(self, store: Store, images: bool) -> None:
        self._images = images
        self._frames = FrameReader(store)
        self._prefix_frames = store.manifest["config"]["prefix_frames"]
        # Items of one scene share many frames, and encoding takes most of an export's time.
        self._encode = lru_cache(maxsize=ENCODED_FRAMES)(self._encode_png)

    def images_per_row(self, configuration: str) -> int:
        """Return the largest number of images in a row of a configuration."""
        counts = {"selection": self._prefix_frames + 4, "retrieval": self._prefix_frames + 1}
        return counts.get(configuration, 1) if self._images else 0

    def row(self, record: SelectionItem | RetrievalQuery | FrameRef, split: str) -> dict[str, Any]:
        """Return a record's values by column; `split` names the database of a frame."""
        if isinstance(record, FrameRef):
            row = {**asdict(record), "database": split}
            return row | ({"image": self._image(record)} if self._images else {})
        frames = sample_prefix_frames(record.prefix_start, record.prefix_stop, self._prefix_frames)
        row = record.to_row() | {"prefix_frames": frames}
        if not self._images:
            return row
        row["prefix_images"] = [self._image(FrameRef(record.scene_id, f)) for f in frames]
        if isinstance(record, RetrievalQuery):
            return row | {"target_image": self._image(record.target)}
        return row | {"candidate_images": [self._image(c) for c in record.candidates]}

    def _image(self, frame: FrameRef) -> dict[str, Any]:
        """An encoded frame in the form that `datasets.Image` stores."""
        name = f"{frame.scene_id}-{frame.frame:03d}.png"
        return {"bytes": self._encode(frame.scene_id, frame.frame), "path": name}

    def _encode_png(self, scene_id: str, frame: int) -> bytes:
        png = io.BytesIO()
        self._frames.image(scene_id, frame).save(png, "PNG", compress_level=1)
        return png.getvalue()
