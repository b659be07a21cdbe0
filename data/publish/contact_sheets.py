"""Contact sheets: one row of captioned frames for each item or query."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from PIL import Image

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.oracle.displacement import cross_scene_displacement
from dynapix.data.oracle.interventions import removal_displacements
from dynapix.data.records import (
    LETTERS,
    FrameRef,
    RetrievalQuery,
    SelectionItem,
    original_scene_id,
    sample_prefix_frames,
)
from dynapix.data.store import Store

INK, GREEN = "#222222", "#1a7f37"
CELL_WIDTH, CAPTION_HEIGHT, HEADING_HEIGHT = 2.3, 0.5, 0.6
"""Sizes in inches."""
LINE_HEIGHT, LINE_CHARACTERS = 0.2, 165
"""Height in inches of a further line of a heading, and the maximum number of its characters."""
GAP = 0.12
"""Width of the gap between the prefix and the candidates, as a fraction of a cell's width."""
DPI = 100
PREFIX_FRAMES = 4
"""Number of frames that represent a prefix on a sheet."""
HEADING_FIELDS = ("framing", "gap", "horizon", "group", "window_family", "difficulty")
"""Fields of a selection item that its heading shows."""


@dataclass(frozen=True)
class CaptionedFrame:
    """A frame with the lines of its caption."""

    image: Image.Image
    caption: tuple[str, ...]
    is_answer: bool = False


@dataclass(frozen=True)
class Row:
    """The heading of an item or query, frames of its prefix, and its candidates."""

    heading: str
    prefix: Sequence[CaptionedFrame]
    candidates: Sequence[CaptionedFrame]


def draw_sheet(rows: Sequence[Row]) -> bytes:
    """Return a PNG with a row of frames for each of `rows`."""
    from matplotlib.figure import Figure

    prefix = max(len(row.prefix) for row in rows)
    columns = prefix + max(len(row.candidates) for row in rows)
    image = rows[0].prefix[0].image
    lines = max(row.heading.count("\n") for row in rows)
    heading_height = HEADING_HEIGHT + LINE_HEIGHT * (lines - 1)
    height = heading_height + CELL_WIDTH * image.height / image.width + CAPTION_HEIGHT
    figure = Figure(figsize=(CELL_WIDTH * (columns + GAP), height * len(rows)), dpi=DPI)
    strips = figure.subfigures(len(rows), squeeze=False)[:, 0]
    layout = {
        "width_ratios": [1.0] * prefix + [GAP] + [1.0] * (columns - prefix),
        "gridspec_kw": {
            "left": 0.01, "right": 0.99, "wspace": 0.06,
            "bottom": CAPTION_HEIGHT / height, "top": 1 - heading_height / height,
        },
    }  # fmt: skip
    for row, strip in zip(rows, strips, strict=True):
        strip.suptitle(row.heading, x=0.01, y=0.96, ha="left", va="top", fontsize=11)
        grid = strip.subplots(1, columns + 1, **layout)
        for axes in grid:
            axes.set_axis_off()
        padding = [None] * (prefix + 1 - len(row.prefix))
        for axes, cell in zip(grid, [*row.prefix, *padding, *row.candidates], strict=False):
            if cell is None:
                continue
            axes.set_axis_on()
            axes.imshow(cell.image)
            axes.set(xticks=[], yticks=[])
            for spine in axes.spines.values():
                spine.set(visible=cell.is_answer, color=GREEN, linewidth=4)
            axes.set_xlabel("\n".join(cell.caption), loc="left", labelpad=6, fontsize=9)
            axes.xaxis.label.set_color(GREEN if cell.is_answer else INK)
    buffer = io.BytesIO()
    # PNGs of matplotlib contain its version by default; equal sheets should have equal bytes.
    figure.savefig(buffer, metadata={"Software": None})
    return buffer.getvalue()


class SheetRows:
    """Makes rows of a contact sheet from the items and queries of a store."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._frames = FrameReader(store)

    def make(self, record: SelectionItem | RetrievalQuery) -> Row:
        """Return the row of an item or a query."""
        heading, cells = (self._item if isinstance(record, SelectionItem) else self._query)(record)
        frames = sample_prefix_frames(record.prefix_start, record.prefix_stop, PREFIX_FRAMES)
        prefix = [self._caption_frame(FrameRef(record.scene_id, f), f"frame {f}") for f in frames]
        return Row(f"{heading}\n{fill(record.question, LINE_CHARACTERS)}", prefix, cells)

    def _item(self, item: SelectionItem) -> tuple[str, list[CaptionedFrame]]:
        """Return the heading and the candidates of an item, with the answer marked."""
        values = {name.replace("_", " "): getattr(item, name) for name in HEADING_FIELDS}
        fields = [f"{name} {value}" for name, value in values.items() if value is not None]
        details = [item.split, *fields, f"minimum displacement {item.min_displacement:.0f} px"]
        cells = []
        for letter, candidate in zip(LETTERS, item.candidates, strict=True):
            distance, nearest = min(
                (self._displacement(candidate, other), other_letter)
                for other_letter, other in zip(LETTERS, item.candidates, strict=True)
                if other != candidate
            )
            caption = f"{_describe_frame(item, candidate)}, {distance:.0f} px from {nearest}"
            source, is_answer = f"{letter}: {candidate.source}", letter == item.letter
            cells.append(self._caption_frame(candidate, source, caption, is_answer=is_answer))
        return f"{item.item_id}    {', '.join(details)}", cells

    def _query(self, query: RetrievalQuery) -> tuple[str, list[CaptionedFrame]]:
        """Return the heading, the target and the hard negatives of a query. The first one of a
        counterfactual query is the factual frame: the scene with the object, at the same moment."""
        caption = _describe_frame(query, query.target)
        cells = [self._caption_frame(query.target, "target", caption, is_answer=True)]
        negatives = list(query.hard_negatives)
        if query.removed_object is not None:
            scene = self._store.scene(query.scene_id)
            counterfactual = self._store.scene(query.target.scene_id)
            removed = [o.noun_phrase for o in scene.objects].index(query.removed_object)
            shift = removal_displacements(scene, counterfactual, removed)[query.target.frame].max()
            caption = f"other objects differ by {shift:.0f} px"
            cells.insert(0, self._caption_frame(negatives.pop(0), "factual", caption))
        for frame in negatives:
            distance = f"{self._displacement(query.target, frame):.0f} px away"
            caption = f"{_describe_frame(query, frame)}, {distance}"
            cells.append(self._caption_frame(frame, "wrong time", caption))
        return f"{query.query_id}    {query.split}, anchor {query.anchor}", cells

    def _caption_frame(
        self, frame: FrameRef, *caption: str, is_answer: bool = False
    ) -> CaptionedFrame:
        return CaptionedFrame(self._frames.image(frame.scene_id, frame.frame), caption, is_answer)

    def _displacement(self, first: FrameRef, second: FrameRef) -> float:
        scenes = self._store.scene(first.scene_id), self._store.scene(second.scene_id)
        return cross_scene_displacement(scenes[0], first.frame, scenes[1], second.frame)


def _describe_frame(record: SelectionItem | RetrievalQuery, frame: FrameRef) -> str:
    """Describe when a frame occurs: its index and, unless it belongs to another scene, its offset
    in frames from the end of the prefix. A counterfactual and an alternative future of the scene
    count as the same scene."""
    is_same_scene = original_scene_id(frame.scene_id) == record.scene_id
    offset = frame.frame - record.prefix_stop
    return f"frame {frame.frame}" + (f" ({offset:+d})" if is_same_scene else "")
