"""Plot the curves of a run from its journal."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dynapix.data.checks.figures import COLORS, DPI, create_figure

MANY_PANELS, LOW_DPI = 8, 60
"""A figure with more panels than this has fewer dots per inch."""


def plot_curves(records: Sequence[dict[str, float]], path: Path | str) -> None:
    """Plot the losses over the steps in one panel, and each other measure in a panel of its own.

    Args:
        records: Lines of a run's journal, each with `step` and with `loss` or measures `eval_*`.
        path: The image file.
    """
    import pandas as pd
    from cycler import cycler

    table = pd.DataFrame([*records] or [{"step": 0}]).groupby("step").last()
    # The columns of each panel, with the labels of their curves.
    panels: dict[str, dict[str, str]] = {"loss": {}}
    for key in sorted(k for k in table if k.startswith("eval_")):
        panel, label = panel_and_label(key.removeprefix("eval_"))
        panels.setdefault(panel, {})[key] = label
    columns = 1 if len(panels) <= 3 else 2
    rows = -(-len(panels) // columns)
    figure = create_figure(8.5 * columns, 0.6 + 2.5 * rows)
    all_axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    if "loss" in table:
        training = table["loss"].dropna()
        all_axes[0].plot(training, color="#999999", linewidth=1.2, label="training")
    for axes, (panel, labels) in zip(all_axes, panels.items(), strict=False):
        axes.set_prop_cycle(cycler(linestyle=("-", ":", "--")) * cycler(color=COLORS))
        for key, label in labels.items():
            axes.plot(table[key].dropna(), linewidth=1.8, marker="o", markersize=4, label=label)
        axes.set(xlabel="step", ylabel=panel)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=DPI if len(panels) <= MANY_PANELS else LOW_DPI)


def panel_and_label(measure: str) -> tuple[str, str]:
    """Return the panel in which a measure is plotted and the label of its curve, such as
    ("letter accuracy", "answer event") for answer_letter_accuracy_event, or ("words region",
    "parse") for words_region/parse."""
    if "/" in measure:
        panel, _, label = measure.replace("_", " ").partition("/")
        return panel, label
    common = re.sub(r"_(event|time|window)$|@\d+$", "", measure).split("_")
    panel = common[-1:] if common[-1] == "loss" else common[-2:]
    rest = " ".join(word for word in measure.split("_") if word not in panel)
    return " ".join(panel), f"held out {rest}" if panel == ["loss"] else rest or measure
