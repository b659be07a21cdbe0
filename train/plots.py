"""The curves of a run, drawn from its journal.

Figures are built without pyplot, so drawing leaves no global state and needs no display.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
COLORS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")
"""Told apart with any colour vision (Paul Tol's bright set)."""
LINES = ("-", ":", "--")
MODE = re.compile(r"eval_(answer_|reasoning_)?")
FAMILY = re.compile(r"_letter_accuracy_(\w+)$")


def empty_figure(width: float, height: float) -> Figure:
    """An empty figure of width x height inches that draws with Agg."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def curves_figure(records: Sequence[dict[str, float]], path: Path | str) -> None:
    """Training and evaluation losses over steps; below them, where they were evaluated, the
    measures of all items, and below these the letter accuracy by family.

    Args:
        records: lines of a run's journal, each with `step` and some of `loss`, `eval_loss`,
            `eval_<name>_loss` and others.
    """
    measured = sorted({k for r in records for k in r if k.startswith("eval_")})
    losses = [k for k in measured if k.endswith("_loss")]
    families = [k for k in measured if FAMILY.search(k)]
    others = [k for k in measured if k not in (*losses, *families)]
    below = [("held out", others), ("letter accuracy", families)]
    panels = [("loss", losses), *((label, keys) for label, keys in below if keys)]
    figure = empty_figure(8.5, 0.6 + 2.5 * len(panels))
    drawn = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    _curve(drawn[0], records, "loss", color="#999999", linewidth=1.2, label="training")
    for axes, (label, keys) in zip(drawn, panels, strict=True):
        for key, style in _styles(keys).items():
            # The losses stand beside the one that is trained on.
            name = f"held out {_name(key)}".strip() if label == "loss" else _name(key)
            _curve(axes, records, key, **style, label=name)
        axes.set_ylabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    drawn[-1].set_xlabel("step")
    figure.savefig(path)


def _styles(keys: Sequence[str]) -> dict[str, dict[str, object]]:
    """A colour for each measure, a line for each mode in which it was taken; where the colours give
    out, the lines tell measures apart too."""
    found = {key: MODE.match(key)[1] or "" for key in keys}
    modes = sorted(set(found.values()))
    measures = sorted({key.replace(mode, "", 1) for key, mode in found.items()})
    styles = {}
    for key, mode in found.items():
        cycle, color = divmod(measures.index(key.replace(mode, "", 1)), len(COLORS))
        styles[key] = {
            "color": COLORS[color],
            "linestyle": LINES[(cycle + modes.index(mode)) % len(LINES)],
            "linewidth": 1.8,
            "marker": "o",
            "markersize": 4,
        }
    return styles


def _name(key: str) -> str:
    name = FAMILY.sub(r"_\1", key)
    return name.removeprefix("eval_").removesuffix("loss").replace("_", " ").strip()


def _curve(axes: Axes, records: Sequence[dict[str, float]], key: str, **style: object) -> None:
    points = {r["step"]: r[key] for r in records if r.get(key) is not None}
    if points:
        axes.plot(*zip(*sorted(points.items()), strict=True), **style)
