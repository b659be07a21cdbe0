"""The curves of a run, drawn from its journal.

Figures are built without pyplot, so drawing leaves no global state and needs no display.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Told apart with any colour vision (Paul Tol's bright set)."""


def empty_figure(width: float, height: float) -> Figure:
    """An empty figure of width x height inches that draws with Agg."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def curves_figure(records: Sequence[dict[str, float]], path: Path | str) -> None:
    """Training and evaluation losses over steps, and below them every other evaluated measure.

    Args:
        records: lines of a run's journal, each with `step` and some of `loss`, `eval_loss`,
            `eval_<name>_loss` and others.
    """
    measured = sorted({k for r in records for k in r if k.startswith("eval_")})
    losses = [k for k in measured if k.endswith("_loss")]
    others = [k for k in measured if k not in losses]
    figure = empty_figure(7, 5.6 if others else 3.6)
    panels = figure.subplots(2 if others else 1, 1, sharex=True, squeeze=False)[:, 0]
    _curve(panels[0], records, "loss", color="#999999", linewidth=1.2, label="training")
    for k, key in enumerate(losses):
        _curve(panels[0], records, key, **_style(k), label=f"held out {_name(key)}".strip())
    for k, key in enumerate(others):
        _curve(panels[1], records, key, **_style(k), label=_name(key))
    for axes, label in zip(panels, ("loss", "held out"), strict=False):
        axes.set_ylabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=9)
    panels[-1].set_xlabel("step")
    figure.savefig(path)


def _style(index: int) -> dict[str, object]:
    cycle, color = divmod(index, len(COLORS))
    line = ("-", ":", "--")[cycle % 3]
    return {
        "color": COLORS[color], "linestyle": line, "linewidth": 1.8, "marker": "o", "markersize": 4
    }  # fmt: skip


def _name(key: str) -> str:
    return key.removeprefix("eval_").removesuffix("loss").replace("_", " ").strip()


def _curve(axes: Axes, records: Sequence[dict[str, float]], key: str, **style: object) -> None:
    points = {r["step"]: r[key] for r in records if r.get(key) is not None}
    if points:
        axes.plot(*zip(*sorted(points.items()), strict=True), **style)
