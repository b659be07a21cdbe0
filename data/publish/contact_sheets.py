"""Contact sheets: rows of frames with what is known about them, and paths over the floor."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from data.records import FPS, Scene
from data.render.appearance import RGB
from data.world.camera import Camera
from data.world.shapes import RADIUS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, FAINT, PAPER, RIGHT = "#222222", "#777777", "#ffffff", "#1a7f37"
CELL = 224
"""Width in px of a frame on a sheet."""
GAP, MARGIN, LINE = 10, 18, 19
BREAK = 26
"""Room between the frames that are observed and those that follow."""
FLOOR = {"across": (-3.6, 3.6), "down": (-4.4, 2.8)}
"""What is drawn of the floor, simulator units; the camera stands further down."""


@dataclass(frozen=True)
class Cell:
    """A frame on a sheet."""

    image: Image.Image
    caption: tuple[str, ...]
    letter: str = ""
    right: bool = False
    """Whether it answers."""
    ring: tuple[float, float] | None = None
    """A place to draw a ring around, as shares of the image's width and height."""


@dataclass(frozen=True)
class Row:
    """An item or a query: its name, what it is, its question, and its frames."""

    name: str
    about: str
    question: str
    observed: Sequence[Cell]
    others: Sequence[Cell]


def sheet(rows: Sequence[Row]) -> bytes:
    """A PNG with a row of frames for each of `rows`."""
    strips = [_strip(row) for row in rows]
    width = max(s.width for s in strips) + 2 * MARGIN
    height = sum(s.height for s in strips) + MARGIN * (len(strips) + 1)
    image = Image.new("RGB", (width, height), PAPER)
    pen = ImageDraw.Draw(image)
    top = MARGIN
    for k, strip in enumerate(strips):
        if k:
            pen.line([(MARGIN, top - MARGIN // 2), (width - MARGIN, top - MARGIN // 2)], "#dddddd")
        image.paste(strip, (MARGIN, top))
        top += strip.height + MARGIN
    return _png(image)


def _strip(row: Row) -> Image.Image:
    cells = [*row.observed, *row.others]
    high = round(CELL * cells[0].image.height / cells[0].image.width)
    lines = max(len(c.caption) for c in cells)
    head = 2 * LINE + 8
    width = len(cells) * (CELL + GAP) + BREAK
    strip = Image.new("RGB", (width, head + high + 6 + lines * LINE), PAPER)
    pen = ImageDraw.Draw(strip)
    pen.text((0, 0), row.name, INK, _font(15, bold=True))
    pen.text((pen.textlength(row.name, _font(15, bold=True)) + 14, 0), row.about, FAINT, _font(15))
    pen.text((0, LINE), row.question, INK, _font(15))
    for k, cell in enumerate(cells):
        left = k * (CELL + GAP) + (BREAK if k >= len(row.observed) else 0)
        _draw_cell(strip, pen, cell, left, head, high)
    across = len(row.observed) * (CELL + GAP) + (BREAK - GAP) // 2
    pen.line([(across, head), (across, head + high)], FAINT, 2)
    return strip


def _draw_cell(
    strip: Image.Image, pen: ImageDraw.ImageDraw, cell: Cell, left: int, top: int, high: int
) -> None:
    image = cell.image.resize((CELL, high), Image.Resampling.LANCZOS)
    if cell.ring is not None:
        x, y = cell.ring[0] * CELL, cell.ring[1] * high
        reach = CELL * 0.085
        circle = [x - reach, y - reach, x + reach, y + reach]
        ImageDraw.Draw(image).ellipse(circle, outline="#ff00aa", width=3)
    strip.paste(image, (left, top))
    if cell.right:
        pen.rectangle([left - 4, top - 4, left + CELL + 3, top + high + 3], outline=RIGHT, width=4)
    if cell.letter:
        color = RIGHT if cell.right else INK
        pen.rectangle([left, top, left + 25, top + 25], fill=color)
        pen.text((left + 13, top + 13), cell.letter, PAPER, _font(17, bold=True), anchor="mm")
    for k, text in enumerate(cell.caption):
        color = INK if k == 0 else FAINT
        bold = k == 0 and cell.right
        pen.text((left, top + high + 6 + k * LINE), text, color, _font(14, bold=bold))


def paths(scenes: Sequence[Scene], columns: int = 3) -> bytes:
    """A PNG with the top view of each of `scenes`, as the camera would see the floor from above:
    its side is below, and its left is left."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(6.2 * columns, 6.6 * rows), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in every[len(scenes) :]:
        axes.set_axis_off()
    for axes, scene in zip(every, scenes, strict=False):
        _paths(axes, scene)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


MARKERS = {"cube": "s", "sphere": "o", "cylinder": "H"}
BESIDE = ((8, 5), (8, -15), (-24, 5), (-24, -15))
"""Where a collision's frame is written, so that those at one place can be read."""


def _paths(axes: Axes, scene: Scene) -> None:
    from matplotlib.patches import Polygon

    axes.set_facecolor("#e4e4e4")
    axes.add_patch(Polygon(_seen_floor(), closed=True, facecolor=PAPER, edgecolor="#bbbbbb"))
    for k, look in enumerate(scene.objects):
        across, down = scene.positions[:, k, 1], scene.positions[:, k, 0]
        color = np.array(RGB[look.color]) / 255
        axes.plot(across, down, color=color, linewidth=2.2, zorder=2)
        axes.plot(across[::FPS], down[::FPS], ".", color=color, markersize=7, zorder=3)
        marker = {"marker": MARKERS[look.shape], "markersize": 13, "linestyle": "none"}
        shine = "#ffffff" if look.material == "metal" else INK
        axes.plot(across[0], down[0], **marker, mfc="none", mec=color, mew=2, zorder=4)
        axes.plot(
            across[-1], down[-1], **marker, mfc=color, mec=shine, mew=1.5, zorder=4,
            label=look.phrase,
        )  # fmt: skip
    for k, collision in enumerate(scene.collisions):
        down, across = scene.positions[collision.frame, list(collision.objects), :2].mean(axis=0)
        axes.plot(across, down, "x", color=INK, markersize=11, mew=2.5, zorder=5)
        axes.annotate(
            str(collision.frame), (across, down), BESIDE[k % len(BESIDE)], color=INK,
            textcoords="offset points", fontsize=11, fontweight="bold", zorder=6, clip_on=True,
        )  # fmt: skip
    axes.set_xlim(*FLOOR["across"])
    axes.set_ylim(*reversed(FLOOR["down"]))
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(f"{scene.scene_id} ({scene.split})", fontsize=13, fontweight="bold")
    axes.set_xlabel("camera's side", fontsize=11)
    axes.legend(fontsize=8.5, loc="lower left", framealpha=0.85, labelspacing=0.7)


def _seen_floor() -> np.ndarray:
    """(4, 2) corners of the floor that the camera sees, across and down the drawing."""
    camera = Camera()
    rays = camera.rays(
        np.array([0, camera.width, camera.width, 0]) - 0.5,
        np.array([0, 0, camera.height, camera.height]) - 0.5,
    )
    height = camera.eye[2] - RADIUS
    points = np.asarray(camera.eye) + rays * (height / -rays[:, 2:])
    return points[:, [1, 0]]


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf" / name, size)


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()
