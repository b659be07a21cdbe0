"""The columns of an exported benchmark: their types, what they mean, and a record's row of them.

Names are those of the records. With images, frames stand beside their references as encoded PNGs.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from data.records import FrameRef, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store

if TYPE_CHECKING:
    from datasets import Features

CONFIGURATIONS = ("selection", "retrieval", "database")
ENCODED = 1_000
"""Encoded frames that are kept, at up to 100 KB each."""
MEANING = {
    "item_id": "Name of the item.",
    "query_id": "Name of the query.",
    "split": "train or test. Scenes keep to one split, in every track.",
    "suite": "dynapix, the simulator of a transfer suite (standin_ before it where Bullet's scenes "
    "stand in for that simulator's), or matched_anchor: pairs of items that differ in their "
    "question's anchor alone.",
    "family": "What fixes the target's moment: event, time or window.",
    "subtype": "The construction cell inside the family.",
    "framing": "Event family: future (the prefix ends before the collision) or contact (at it).",
    "distractors": "Where the wrong candidates come from.",
    "gap": "Event family: frames from the prefix's end to the target.",
    "horizon": "Time and window families: frames from the prefix's end to the target.",
    "group": "Window family: what happens ahead, G1 (nothing) to G4 (several events).",
    "window_family": "Window family: built around the whole scene (A), a colliding pair (B) or "
    "the object that moves most (C).",
    "difficulty": "Window family: hard (distractors nearest to the target) or easy (far ones).",
    "pool": "future, or counterfactual (the scene had one object been absent).",
    "builder": "1 to 6 for the future pool, null for the counterfactual one.",
    "anchor": "What the question names: a time, an event or an intervention.",
    "question": "The question as a model is asked it.",
    "scene_id": "The scene, one simulated video.",
    "prefix_start": "First observed frame.",
    "prefix_stop": "Last observed frame, inclusive.",
    "shown_frames": "The frames of the prefix that a model is shown, evenly spread.",
    "prefix_images": "The shown frames, in order of time.",
    "target_frame": "The frame that answers, of the item's own scene.",
    "event_frame": "Event family: the first frame at or after the contact.",
    "candidates": "Four frames in a seeded order, one of them the target.",
    "candidate_images": "The four candidates, in their order.",
    "answer": "Position of the target among the candidates, 0 to 3.",
    "min_displacement": "Least displacement between two candidates, in px at 336 x 336.",
    "removed_object": "Counterfactual pool: noun phrase of the object that is absent.",
    "standard": "Whether the query belongs to the standard test, over the database test.",
    "target": "The frame that answers.",
    "target_image": "The target.",
    "hard_negatives": "Wrong frames that are easily taken for the target.",
    "database": "Name of the database: test (the standard test's), future (the source of the "
    "future pool, which holds test) or counterfactual (the source of that pool).",
    "frame": "Index of the frame in its scene, from 0, 25 a second.",
    "source": "target, or where the distractor comes from.",
    "image": "The frame.",
}


def features(images: bool) -> dict[str, Features]:
    """The columns of each configuration, in order."""
    from datasets import Features, Image, List, Value

    text, whole = Value("string"), Value("int64")
    frame = {"scene_id": text, "frame": whole}
    prefix = {"scene_id": text, "prefix_start": whole, "prefix_stop": whole}
    shown = {"shown_frames": List(whole)}
    if images:
        shown["prefix_images"] = List(Image())
    selection = {
        **dict.fromkeys(("item_id", "split", "suite", "family", "subtype"), text),
        **dict.fromkeys(("framing", "distractors"), text),
        **dict.fromkeys(("gap", "horizon"), whole),
        **dict.fromkeys(("group", "window_family", "difficulty", "question"), text),
        **prefix,
        **shown,
        **dict.fromkeys(("target_frame", "event_frame"), whole),
        "candidates": List({**frame, "source": text}),
        **({"candidate_images": List(Image())} if images else {}),
        "answer": whole,
        "min_displacement": Value("float64"),
    }
    retrieval = {
        **dict.fromkeys(("query_id", "split", "pool"), text),
        "builder": whole,
        **dict.fromkeys(("anchor", "question"), text),
        **prefix,
        **shown,
        "removed_object": text,
        "standard": Value("bool"),
        "target": frame,
        **({"target_image": Image()} if images else {}),
        "hard_negatives": List(frame),
    }
    database = {"database": text, **frame, **({"image": Image()} if images else {})}
    tables = zip(CONFIGURATIONS, (selection, retrieval, database), strict=True)
    return {name: Features(columns) for name, columns in tables}


class Rows:
    """Turns a store's records into rows, with their frames where `images` is set."""

    def __init__(self, store: Store, images: bool) -> None:
        self._images = images
        self._frames = FrameReader(store)
        self._shown = store.manifest["config"]["prefix_frames"]
        # Questions about one scene share many frames, and encoding takes longer than all else.
        self._encoded = lru_cache(maxsize=ENCODED)(self._encode)

    def images_of(self, configuration: str) -> int:
        """Images a row of a configuration, at most."""
        prefix = self._shown
        return {"selection": prefix + 4, "retrieval": prefix + 1, "database": 1}[configuration]

    def row(self, record: SelectionItem | RetrievalQuery | FrameRef, split: str) -> dict[str, Any]:
        if isinstance(record, FrameRef):
            row = {**asdict(record), "database": split}
            return row | ({"image": self._picture(record)} if self._images else {})
        shown = sample_prefix_frames(record.prefix_start, record.prefix_stop, self._shown)
        row = record.to_row() | {"shown_frames": shown}
        if not self._images:
            return row
        row["prefix_images"] = self._pictures(record.scene_id, shown)
        if isinstance(record, RetrievalQuery):
            return row | {"target_image": self._picture(record.target)}
        return row | {"candidate_images": [self._picture(c) for c in record.candidates]}

    def _pictures(self, scene_id: str, frames: Sequence[int]) -> list[dict[str, Any]]:
        """Encoded frames as `datasets.Image` keeps them."""
        return [self._picture(FrameRef(scene_id, frame)) for frame in frames]

    def _picture(self, frame: FrameRef) -> dict[str, Any]:
        path = f"{frame.scene_id}-{frame.frame:03d}.png"
        return {"bytes": self._encoded(frame.scene_id, frame.frame), "path": path}

    def _encode(self, scene_id: str, frame: int) -> bytes:
        png = io.BytesIO()
        self._frames.image(scene_id, frame).save(png, "PNG", compress_level=1)
        return png.getvalue()
