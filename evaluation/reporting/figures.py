"""The figures of evaluations and of the report. A file's suffix determines its format."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import IO

import numpy as np

from dynapix.data.checks.figures import COLORS, GRID, INK, create_figure, legend_above
from dynapix.data.checks.intervals import Interval
from dynapix.evaluation.metrics.results import RECALLS, UNTRAINED, RetrievalResult
from dynapix.evaluation.reporting.reference import COT_STUDENT, cot_student

GRAYS = ("#999999", "#555555", "#cccccc")
"""Colors of untrained models."""


def choose_colors(labels: Sequence[str]) -> list[str]:
    """Return a color for each model: a gray for an untrained one."""
    grays, colors = cycle(GRAYS), cycle(COLORS)
    return [next(grays if label.startswith(UNTRAINED) else colors) for label in labels]


def plot_accuracies(
    accuracy: Mapping[str, Mapping[str, Interval]], file: Path | IO[bytes], with_paper: bool = True
) -> None:
    """Plot accuracies (%) with 95% intervals: groups of bars, in which each model has a color.

    Args:
        accuracy: The accuracy of each model, by the model's label and by family or horizon.
        with_paper: Whether the accuracies of the paper's CoT student are plotted as diamonds.
    """
    groups = list(dict.fromkeys(group for by_group in accuracy.values() for group in by_group))
    figure = create_figure(8, 4.4)
    axes = figure.add_subplot()
    width, colors = 0.84 / (len(accuracy) + 1), choose_colors([*accuracy])
    for i, (label, by_group) in enumerate(accuracy.items()):
        bars = [(k, by_group[group]) for k, group in enumerate(groups) if group in by_group]
        xs = [k + (i - len(accuracy) / 2) * width for k, _ in bars]
        heights, low, high = 100 * np.array([(a.value, a.low, a.high) for _, a in bars]).T
        style = {"color": colors[i], "hatch": "//" * colors[:i].count(colors[i])}
        axes.bar(xs, heights, width * 0.9, edgecolor="#ffffff", label=label, **style)
        middle, half_length = (high + low) / 2, (high - low) / 2
        axes.errorbar(xs, middle, half_length, fmt="none", ecolor=INK, capsize=3, elinewidth=1.2)
    paper = cot_student() if with_paper else {}
    if in_paper := [k for k, group in enumerate(groups) if group in paper]:
        xs = [k + len(accuracy) / 2 * width for k in in_paper]
        values = [paper[groups[k]] for k in in_paper]
        axes.scatter(
            xs, values, 60, marker="D", color="#ffffff", edgecolors=INK, linewidths=1.5,
            label=f"paper: {COT_STUDENT}, 8B",
        )  # fmt: skip
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0, label="chance")
    axes.set_xticks(range(len(groups)), [group.capitalize() for group in groups])
    axes.set(xlim=(-0.5, len(groups) - 0.5), ylim=(0, 108), ylabel="Accuracy (%)")
    axes.set_yticks(range(0, 101, 25))
    axes.spines[["top", "right"]].set_visible(False)
    legend_above(figure, axes)
    figure.savefig(file)


def plot_recalls(rows: Iterable[tuple[str, RetrievalResult]], file: Path | IO[bytes]) -> None:
    """Plot Recall@1, @10 and @50 (%) over the embedding width, with 95% intervals as bands.

    Args:
        rows: Names of retrievers, and results. Results for a single builder, and those without a
            width, are not plotted. The lines of untrained retrievers are dashed.
    """
    lines: dict[str, list[RetrievalResult]] = {}
    for name, result in rows:
        if result.width and result.builder is None:
            lines.setdefault(name, []).append(result)
    names = sorted(lines, key=lambda name: (name.startswith(UNTRAINED), name))
    figure = create_figure(9, 3.8)
    panels = figure.subplots(1, len(RECALLS), sharey=True)
    for axes, k in zip(panels, RECALLS, strict=True):
        for name, color in zip(names, choose_colors(names), strict=True):
            by_width = sorted(lines[name], key=lambda r: r.width)
            recalls = [r.measures[f"recall@{k}"] for r in by_width]
            widths = [r.width for r in by_width]
            style = "--o" if name.startswith(UNTRAINED) else "-o"
            value, low, high = 100 * np.array([(r.value, r.low, r.high) for r in recalls]).T
            axes.fill_between(widths, low, high, color=color, alpha=0.14, linewidth=0)
            axes.plot(widths, value, style, color=color, markersize=4, label=name)
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter("{x:.0f}")
        axes.set(xlabel="Embedding width", ylim=(0, None))
        axes.set_title(f"Recall@{k}", fontsize=11)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=GRID)
    panels[0].set_ylabel("Queries (%)")
    legend_above(figure, panels[0])
    figure.savefig(file)
