"""The figures of a benchmark's statistics, and what all figures share.

Figures are built without pyplot, so that they leave no global state and need no display.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Colors that people with any colour vision can distinguish (Paul Tol's bright set)."""


def create_figure(width: float, height: float) -> Figure:
    """Return an empty figure of width x height inches with the Agg backend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure
