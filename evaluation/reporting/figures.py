"""The figures of evaluations and of the report, written in the format of the file's suffix.

Figures are built without pyplot, so that they leave no global state and need no display.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evaluation.metrics.intervals import Interval
from evaluation.metrics.results import RECALLS, UNTRAINED, RetrievalResult
from evaluation.reporting.reference import COT_STUDENT, cot_student
from train.common.curves import COLORS, empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GRID = "#333333", "#eeeeee"
GRAY = "#999999"
"""Color of untrained retrievers."""


def accuracy_figure(
    shares: Mapping[str, Mapping[str, Interval]], path: Path | str, with_paper: bool = True
) -> None:
    """Plot bars of accuracy (%) with 95% intervals by family or horizon, a color for each model.

    Args:
        shares: Accuracy by label of the model and by family or horizon.
        with_paper: Whether the paper's CoT student is plotted as diamonds.
    """
    groups = list(dict.fromkeys(group for of_model in shares.values() for group in of_model))
    figure = empty_figure(8, 4.4)
    axes = figure.add_subplot()
    width = 0.84 / (len(shares) + 1)
    for i, (label, of_model) in enumerate(shares.items()):
        found = [of_model[group] for group in groups if group in of_model]
        xs = [k + (i - len(shares) / 2) * width for k, g in enumerate(groups) if g in of_model]
        heights, low, high = 100 * np.array([(s.value, s.low, s.high) for s in found]).T
        color = GRAY if label.startswith(UNTRAINED) else COLORS[i % len(COLORS)]
        axes.bar(xs, heights, width * 0.9, color=color, label=label)
        middle, reach = (high + low) / 2, (high - low) / 2
        axes.errorbar(xs, middle, reach, fmt="none", ecolor=INK, capsize=3, elinewidth=1.2)
    printed = cot_student() if with_paper else {}
    if places := [k for k, group in enumerate(groups) if group in printed]:
        xs = [k + len(shares) / 2 * width for k in places]
        values = [printed[groups[k]] for k in places]
        axes.scatter(
            xs, values, 60, marker="D", color="#ffffff", edgecolors=INK, linewidths=1.5,
            label=f"paper: {COT_STUDENT}, 8B",
        )  # fmt: skip
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0, label="chance")
    axes.set_xticks(range(len(groups)), [group.capitalize() for group in groups])
    axes.set(xlim=(-0.5, len(groups) - 0.5), ylim=(0, 108), ylabel="Accuracy (%)")
    axes.set_yticks(range(0, 101, 25))
    axes.spines[["top", "right"]].set_visible(False)
    _legend_above(figure, axes)
    figure.savefig(path)


def retrieval_figure(results: Iterable[tuple[str, RetrievalResult]], path: Path | str) -> None:
    """Plot Recall@1, @10 and @50 (%) over the embedding width, with 95% bands.

    Args:
        results: Results by name. Only those over all queries at a width are plotted; untrained
            retrievers are dashed.
    """
    lines: dict[str, list[RetrievalResult]] = {}
    for name, result in results:
        if result.width and result.builder is None:
            lines.setdefault(name, []).append(result)
    names = sorted(lines, key=lambda name: (name.startswith(UNTRAINED), name))
    figure = empty_figure(9, 3.8)
    panels = figure.subplots(1, len(RECALLS), sharey=True)
    for axes, k in zip(panels, RECALLS, strict=True):
        for i, name in enumerate(names):
            of_name = sorted(lines[name], key=lambda r: r.width)
            found = [r.measures[f"recall@{k}"] for r in of_name]
            value, low, high = 100 * np.array([(f.value, f.low, f.high) for f in found]).T
            widths, untrained = [r.width for r in of_name], name.startswith(UNTRAINED)
            color = GRAY if untrained else COLORS[i % len(COLORS)]
            axes.fill_between(widths, low, high, color=color, alpha=0.14, linewidth=0)
            style = "--o" if untrained else "-o"
            axes.plot(widths, value, style, color=color, markersize=4, label=name)
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter("{x:.0f}")
        axes.set(xlabel="Embedding width", ylim=(0, None))
        axes.set_title(f"Recall@{k}", fontsize=11)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=GRID)
    panels[0].set_ylabel("Queries (%)")
    _legend_above(figure, panels[0])
    figure.savefig(path)


def _legend_above(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    # A dollar sign would begin a formula.
    labels = [label.replace("$", r"\$") for label in labels]
    figure.legend(
        handles, labels, loc="outside upper left", ncols=2, fontsize=9, frameon=False
    )  # fmt: skip
