"""The figures of evaluations and of the report. Each function writes one, in its suffix's format.

Figures are built without pyplot, so that they leave no global state and need no display.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data.records import LETTERS
from evaluation.metrics.intervals import Interval
from evaluation.metrics.results import RECALLS, UNTRAINED, RetrievalResult
from evaluation.reporting.reference import COT_STUDENT, cot_student
from train.common.curves import COLORS, empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, GRID = "#333333", "#bbbbbb", "#eeeeee"
GRAY = "#999999"
"""Color of untrained retrievers."""
"""Prefix frames in one line of an item's figure."""


def accuracy_figure(
    shares: Mapping[str, Mapping[str, Interval]], path: Path | str, with_paper: bool = True
) -> None:
    """Bars of accuracy (%) by family or horizon with 95% intervals, a color for each model.

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


def count_confusions(pairs: Sequence[tuple[str, str | None]]) -> np.ndarray:
    """(4, 5) counts of (correct letter, chosen letter); the last column counts unparsed answers."""
    counts = np.zeros((len(LETTERS), len(LETTERS) + 1), int)
    for correct, chosen in pairs:
        column = len(LETTERS) if chosen is None else LETTERS.index(chosen)
        counts[LETTERS.index(correct), column] += 1
    return counts


def confusion_figure(counts_by_model: Mapping[str, np.ndarray], path: Path) -> None:
    """Chosen letters where each letter was correct, in percent of a row, a panel for each model."""
    columns = min(3, len(counts_by_model))
    rows = -(-len(counts_by_model) // columns)
    figure = empty_figure(2.9 * max(2, columns), 2.9 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(counts_by_model) :]:
        axes.set_axis_off()
    for axes, (name, counts) in zip(panels, counts_by_model.items(), strict=False):
        shares = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        for (i, j), share in np.ndenumerate(shares):
            # Squares, not an image: the white of an image would not follow the page's colors.
            xs = (j - 0.48, j + 0.48, j + 0.48, j - 0.48)
            ys = (i - 0.48, i - 0.48, i + 0.48, i + 0.48)
            color = COLORS[0] if i == j else COLORS[1]
            axes.fill(xs, ys, color=color, alpha=0.85 * share / 100, linewidth=0)
            axes.text(j, i, f"{share:.0f}", ha="center", va="center", fontsize=10, color=INK)
        axes.set_xticks(range(len(LETTERS) + 1), [*LETTERS, "none"])
        axes.set_yticks(range(len(LETTERS)), LETTERS)
        axes.set_xlim(-0.5, len(LETTERS) + 0.5)
        axes.set_ylim(len(LETTERS) - 0.5, -0.5)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(_escape(name if len(name) < 34 else f"{name[:32]}…"), fontsize=9)
        axes.set_xlabel("chosen", fontsize=9)
        axes.set_ylabel("correct", fontsize=9)
    figure.savefig(path)


def retrieval_figure(results: Iterable[tuple[str, RetrievalResult]], path: Path | str) -> None:
    """Recall@1, @10 and @50 (%) of all queries by embedding width, with 95% bands, for named
    results; untrained retrievers are dashed. Results without a width are left out."""
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
            widths, style = [r.width for r in of_name], _line_style(name, i)
            axes.fill_between(widths, low, high, color=style["color"], alpha=0.14, linewidth=0)
            axes.plot(widths, value, marker="o", markersize=4, **style)
        _recall_axes(axes, "Embedding width", 2)
        axes.set_title(f"Recall@{k}", fontsize=11)
    panels[0].set_ylabel("Queries (%)")
    _legend_above(figure, panels[0])
    figure.savefig(path)


def recall_figure(curves: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Recall (%) of all queries by k, a line for each retriever at its largest width; untrained
    ones are dashed.

    Args:
        curves: By name, as `evaluation.metrics.results.recall_curve` returns them.
    """
    figure = empty_figure(7, 4.2)
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(curves.items()):
        axes.plot(curve["ks"], 100 * np.array(curve["recalls"]), **_line_style(name, i))
    _recall_axes(axes, "k", 10)
    axes.set_ylabel("Queries (%)")
    _legend_above(figure, axes)
    figure.savefig(path)


def _line_style(name: str, index: int) -> dict[str, Any]:
    if name.startswith(UNTRAINED):
        return {"color": GRAY, "linestyle": "--", "label": name}
    return {"color": COLORS[index % len(COLORS)], "label": name}


def _recall_axes(axes: Axes, label: str, base: int) -> None:
    from matplotlib.ticker import StrMethodFormatter

    axes.set_xscale("log", base=base)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:.0f}"))
    axes.set(xlabel=label, ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GRID)


def _escape(name: str) -> str:
    """A name in which a dollar sign does not begin a formula."""
    return name.replace("$", r"\$")


def _legend_above(figure: Figure, axes: Axes) -> None:
    """A legend above the plot, the paper's row last."""
    handles, labels = axes.get_legend_handles_labels()
    pairs = sorted(zip(labels, handles, strict=True), key=lambda pair: pair[0].startswith("paper"))
    figure.legend(
        [handle for _, handle in pairs], [_escape(label) for label, _ in pairs],
        loc="outside upper left", ncols=2, fontsize=9, frameon=False,
    )  # fmt: skip
