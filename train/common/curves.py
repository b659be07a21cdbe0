"""Plot the curves of a run from its journal.

Figures are built without pyplot, so plotting leaves no global state and needs no display.
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
"""Distinguishable with any colour vision (Paul Tol's bright set)."""
LINES = ("-", ":", "--")
MODE = re.compile(r"eval_(answer_|reasoning_)?")
FAMILY = re.compile(r"_letter_accuracy_(\w+)$")


def empty_figure(width: float, height: float) -> Figure:
    """Return an empty figure of width x height inches with the Agg backend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def plot_curves(records: Sequence[dict[str, float]], path: Path | str) -> None:
    """Plot losses over steps, then the measures of all items (on separate axes if they are many)
    and the letter accuracy by family.

    Args:
        records: Lines of a run's journal, each with `step` and some of `loss`, `eval_loss`,
            `eval_<name>_loss` and others.
    """
    measured = sorted({k for r in records for k in r if k.startswith("eval_")})
    losses = [k for k in measured if k.endswith("_loss")]
    families = [k for k in measured if FAMILY.search(k)]
    others = [k for k in measured if k not in (*losses, *families)]
    below = [*_by_measure(others).items(), ("letter accuracy by family", families)]
    panels = [("loss", losses), *((label, keys) for label, keys in below if keys)]
    columns = 1 if len(panels) <= 3 else 2
    rows = -(-len(panels) // columns)
    figure = empty_figure(8.5 * columns, 0.6 + 2.5 * rows)
    panes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axes in panes[len(panels) :]:
        axes.set_axis_off()
    _curve(panes[0], records, "loss", color="#999999", linewidth=1.2, label="training")
    for axes, (label, keys) in zip(panes, panels, strict=False):
        for key, style in _styles(keys).items():
            # Held-out losses share the axes of the training loss.
            name = f"held out {_name(key)}" if label == "loss" else _name(key).removesuffix(label)
            _curve(axes, records, key, **style, label=name.strip() or label)
        axes.set_ylabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    for axes in panes[len(panels) - columns : len(panels)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("step")
    figure.savefig(path)


def _by_measure(keys: Sequence[str]) -> dict[str, list[str]]:
    """Group measures by the label of their axes: all together if there are enough colours, else by
    their last two words, such as the place accuracy of several kinds of samples."""
    if len(keys) <= len(COLORS):
        return {"held out": list(keys)}
    found: dict[str, list[str]] = {}
    for key in keys:
        found.setdefault(" ".join(_name(key).split()[-2:]), []).append(key)
    return found


def _styles(keys: Sequence[str]) -> dict[str, dict[str, object]]:
    """Assign a colour to each measure and a line style to each mode; with too few colours, the line
    styles distinguish measures too."""
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
