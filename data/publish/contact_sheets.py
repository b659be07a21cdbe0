"""Contact sheets: one row of captioned frames for each item or query."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from PIL import Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GREEN, PINK = "#222222", "#1a7f37", "#ff00aa"
CELL_WIDTH, CAPTION_HEIGHT, HEADING_HEIGHT = 2.3, 0.5, 0.6
"""Sizes in inches."""
GAP = 0.12
"""Width between the prefix and the candidates, as a share of a cell's."""
RING = 28
"""Diameter of a ring in points."""
DPI = 100


@dataclass(frozen=True)
class Cell:
    """A captioned frame.

    Attributes:
        image: The frame.
        caption: Lines below the frame.
        is_answer: Whether to mark the frame as the answer.
        ring: Centre of a ring in px of the image.
    """

    image: Image.Image
    caption: tuple[str, ...]
    is_answer: bool = False
    ring: tuple[float, float] | None = None


@dataclass(frozen=True)
class Row:
    """An item or a query: its heading, frames of its prefix, and the frames to choose from."""

    name: str
    details: str
    question: str
    prefix: Sequence[Cell]
    candidates: Sequence[Cell]


def draw_sheet(rows: Sequence[Row]) -> bytes:
    """Return a PNG with a row of frames for each of `rows`."""
    from matplotlib.figure import Figure

    prefix = max(len(row.prefix) for row in rows)
    columns = prefix + max(len(row.candidates) for row in rows)
    image = rows[0].prefix[0].image
    height = HEADING_HEIGHT + CELL_WIDTH * image.height / image.width + CAPTION_HEIGHT
    figure = Figure(figsize=(CELL_WIDTH * (columns + GAP), height * len(rows)), dpi=DPI)
    strips = figure.subfigures(len(rows), squeeze=False)[:, 0]
    layout = {
        "width_ratios": [1.0] * prefix + [GAP] + [1.0] * (columns - prefix),
        "gridspec_kw": {
            "left": 0.01, "right": 0.99, "wspace": 0.06,
            "bottom": CAPTION_HEIGHT / height, "top": 1 - HEADING_HEIGHT / height,
        },
    }  # fmt: skip
    for row, strip in zip(rows, strips, strict=True):
        heading = f"{row.name}    {row.details}\n{row.question}"
        strip.suptitle(heading, x=0.01, y=0.96, ha="left", va="top", fontsize=11)
        grid = strip.subplots(1, columns + 1, **layout)
        for axes in grid:
            axes.set_axis_off()
        padding = [None] * (prefix + 1 - len(row.prefix))
        for axes, cell in zip(grid, [*row.prefix, *padding, *row.candidates], strict=False):
            if cell:
                draw_cell(axes, cell)
    return encode_figure(figure)


def draw_cell(axes: Axes, cell: Cell) -> None:
    """Draw a frame with its caption, and its answer mark and ring if it has them."""
    axes.set_axis_on()
    axes.imshow(cell.image)
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(visible=cell.is_answer, color=GREEN, linewidth=4)
    axes.set_xlabel("\n".join(cell.caption), loc="left", labelpad=6, fontsize=9)
    axes.xaxis.label.set_color(GREEN if cell.is_answer else INK)
    if cell.ring:
        axes.autoscale(False)
        axes.plot(*cell.ring, "o", mfc="none", mec=PINK, markersize=RING, mew=3)


def encode_figure(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG, which depend on the drawing alone."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()
