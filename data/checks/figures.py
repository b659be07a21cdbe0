"""What all figures share. Figures are built without pyplot, so that they leave no global state and
need no display."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GRID = "#333333", "#eeeeee"
DPI = 150
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Colors that people with any colour vision can distinguish (Paul Tol's bright set)."""
LEGEND_WIDTH = 100
"""Maximum characters of a line of a legend."""
LEGEND_ROWS, LEGEND_LINE = 4, 0.18
"""Number of rows of a legend for which a figure has room, and the height of another row, inches."""


def create_figure(width: float, height: float) -> Figure:
    """Return an empty figure of width x height inches with the Agg backend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def legend_above(figure: Figure, axes: Axes) -> None:
    """Add the legend of axes above them, in a figure that grows with it."""
    handles, labels = axes.get_legend_handles_labels()
    # Matplotlib would read the text between two dollar signs as a formula.
    labels = [fill(label.replace("$", r"\$"), LEGEND_WIDTH) for label in labels]
    columns = 2 if max(map(len, labels)) <= LEGEND_WIDTH / 2 else 1
    rows = sum(label.count("\n") + 1 for label in labels) / columns
    figure.set_figheight(figure.get_figheight() + LEGEND_LINE * max(0, rows - LEGEND_ROWS))
    figure.legend(
        handles, labels, loc="outside upper left", ncols=columns, fontsize=9, frameon=False
    )  # fmt: skip
