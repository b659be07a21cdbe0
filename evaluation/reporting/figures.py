"""The figures of evaluations and of the report. Each function writes one, in its suffix's format.

Figures are built without pyplot, so that they leave no global state and need no display.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data.records import FAMILIES, LETTERS
from evaluation.metrics.intervals import Interval, wilson_interval
from evaluation.reporting.reference import COT_STUDENT, cot_student
from evaluation.reporting.results import RECALLS, UNTRAINED, RetrievalResult, SelectionResult
from train.common.curves import COLORS, empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

INK, FAINT, GRID, GREEN, RED = "#333333", "#bbbbbb", "#eeeeee", "#228833", "#cc3311"
PREFIX_COLUMNS = 6
"""Prefix frames in one line of an item's figure."""
MAX_NUMBERED = 6
"""Most rows whose bars have room for their numbers."""
HORIZONS = {"time/in_1s": "1 s", "time/in_2s": "2 s"}
WINDOW_SUBTYPE = re.compile(r"window/.*_h(\d+)_")
"""Matches the horizon of a window subtype, in frames."""


def selection_figure(
    rows: Sequence[SelectionResult], path: Path | str, with_paper: bool = True
) -> None:
    """Bars of accuracy (%) by family with 95% intervals, a color for each row; optionally the
    paper's reasoning student as diamonds."""
    figure = empty_figure(8, 4.4)
    axes = figure.add_subplot()
    width = 0.84 / (len(rows) + 1)
    for i, row in enumerate(rows):
        for at, family in enumerate(FAMILIES):
            share = row.families.get(family)
            if share is None:
                continue
            x, value = at + (i - len(rows) / 2) * width, 100 * share.value
            label = f"{row.name} ({row.mode})" if family == next(iter(row.families)) else None
            axes.bar(x, value, width * 0.9, color=_color(row.name, i), label=label)
            middle, reach = 50 * (share.high + share.low), 50 * (share.high - share.low)
            axes.errorbar(x, middle, reach, fmt="none", ecolor=INK, capsize=3, elinewidth=1.2)
            if len(rows) <= MAX_NUMBERED:
                _write_number(axes, x, 100 * share.high, value)
    if with_paper:
        values = [cot_student()[family.capitalize()] for family in FAMILIES]
        places = [at + len(rows) / 2 * width for at in range(len(FAMILIES))]
        _plot_paper(axes, places, values)
        for x, value in zip(places, values, strict=True):
            _write_number(axes, x, value + 1.5, value)
    axes.annotate(
        "chance", (1, 25), (4, 0), xycoords=("axes fraction", "data"), textcoords="offset points",
        va="center", fontsize=9, color=INK,
    )  # fmt: skip
    axes.tick_params(axis="x", length=0)
    _accuracy_axes(axes, [family.capitalize() for family in FAMILIES])
    _legend_above(figure, axes)
    figure.savefig(path)


def accuracy_by_horizon(subtypes: Mapping[str, Interval]) -> dict[str, Interval]:
    """Accuracy by horizon, nearest first, with Wilson intervals: frames for the window family, 1 s
    and 2 s for the time family.

    Args:
        subtypes: Accuracy by `family/subtype`.
    """
    pooled: dict[str, list[float]] = {}
    for subtype, share in subtypes.items():
        window = WINDOW_SUBTYPE.match(subtype)
        horizon = f"{window[1]} frames" if window else HORIZONS.get(subtype)
        if horizon is not None:
            right, n = pooled.get(horizon, (0.0, 0))
            pooled[horizon] = (right + share.value * share.n, n + share.n)
    return {
        horizon: Interval(right / n, *wilson_interval(right, n), n)
        for horizon, (right, n) in sorted(pooled.items(), key=lambda item: _horizon_order(item[0]))
    }


def _horizon_order(horizon: str) -> tuple[bool, int]:
    """Sorts horizons, nearest first: those in frames are all below one second."""
    return horizon.endswith(" s"), int(horizon.split()[0])


def horizon_figure(
    shares: Mapping[str, Mapping[str, Interval]], path: Path, with_paper: bool = True
) -> None:
    """Accuracy (%) by horizon with 95% intervals, a color for each model; optionally the paper's
    reasoning student as diamonds.

    Args:
        shares: `accuracy_by_horizon` of each model.
    """
    horizons = sorted({h for by_horizon in shares.values() for h in by_horizon}, key=_horizon_order)
    figure = empty_figure(7, 4.2)
    axes = figure.add_subplot()
    for k, (name, by_horizon) in enumerate(shares.items()):
        offset = (k - (len(shares) - 1) / 2) * 0.08
        points = [(i, by_horizon[h]) for i, h in enumerate(horizons) if h in by_horizon]
        values = np.array([100 * share.value for _, share in points])
        ends = np.array([[100 * share.low, 100 * share.high] for _, share in points])
        axes.errorbar(
            [i + offset for i, _ in points], values, np.abs(ends.T - values), fmt="o",
            color=COLORS[k % len(COLORS)], capsize=3, markersize=6, elinewidth=1.2, label=name,
        )  # fmt: skip
    printed = cot_student()["horizons"]
    places = [i for i, horizon in enumerate(horizons) if horizon in printed]
    if places and with_paper:
        _plot_paper(axes, places, [printed[horizons[i]] for i in places])
    _accuracy_axes(axes, horizons)
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


def retrieval_figure(rows: Sequence[RetrievalResult], path: Path | str) -> None:
    """Recall@1, @10 and @50 (%) of all queries by embedding width, with 95% bands; untrained
    retrievers are dashed. Rows without a width are left out."""
    rows = sorted((r for r in rows if r.width and r.builder is None), key=lambda r: r.width)
    names = sorted({r.name for r in rows}, key=lambda name: (name.startswith(UNTRAINED), name))
    figure = empty_figure(9, 3.8)
    panels = figure.subplots(1, len(RECALLS), sharey=True)
    for axes, k in zip(panels, RECALLS, strict=True):
        for i, name in enumerate(names):
            points = [(r.width, r.measures[f"recall@{k}"]) for r in rows if r.name == name]
            untrained = name.startswith(UNTRAINED)
            style = {
                "color": _color(name, i), "marker": "o", "markersize": 5, "linewidth": 1.8,
                "linestyle": "--" if untrained else "-",
                "markerfacecolor": "white" if untrained else None,
            }  # fmt: skip
            _plot_recalls(axes, points, label=name, clip_on=False, **style)
        _width_axis(axes, sorted({r.width for r in rows}))
        axes.set_title(f"Recall@{k}", fontsize=11)
    panels[0].set_ylim(0, None)
    panels[0].set_ylabel("Queries (%)")
    figure.supxlabel("Embedding width", fontsize=10)
    _legend_above(figure, panels[0])
    figure.savefig(path)


def builders_figure(
    rows: Sequence[RetrievalResult], curves: Sequence[dict[str, Any]], path: Path | str
) -> None:
    """For the first retriever of `rows`: recall (%) by k at its largest width, and Recall@10 by
    width, a line for each builder; all queries in black with their 95% band.

    Args:
        curves: As `evaluation.metrics.breakdown.recall_curves` gives them.
    """
    name, widest = rows[0].name, rows[0].width
    figure = empty_figure(9, 4.2)
    left, right = figure.subplots(1, 2, sharey=True)
    for curve in reversed([c for c in curves if c["name"] == name]):
        recalls = [100 * recall for recall in curve["recalls"]]
        left.plot(curve["ks"], recalls, **_builder_style(curve["builder"]))
    own = sorted((r for r in rows if r.name == name and r.width), key=lambda r: r.width)
    for builder in reversed(list(dict.fromkeys(r.builder for r in own))):
        points = [(r.width, r.recall_10) for r in own if r.builder == builder]
        style = {"marker": "o", "markersize": 4, **_builder_style(builder)}
        _plot_recalls(right, points, band=builder is None, **style)
    _k_axis(left)
    left.set_title(f"Recall@k at width {widest}", fontsize=11)
    _width_axis(right, sorted({r.width for r in own}))
    right.set_xlabel("Embedding width")
    right.set_title("Recall@10", fontsize=11)
    left.set_ylim(0, None)
    left.set_ylabel("Queries (%)")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(
        handles[::-1], labels[::-1], loc="outside right center", fontsize=9, frameon=False,
        title=_escape(textwrap.fill(name, 18)), title_fontsize=9,
    )  # fmt: skip
    figure.savefig(path)


def recall_figure(curves: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Recall (%) of all queries by k, a line for each retriever at its largest width; untrained
    ones are dashed.

    Args:
        curves: As `evaluation.metrics.breakdown.recall_curves` gives them, of all queries.
    """
    figure = empty_figure(7, 4.2)
    axes = figure.add_subplot()
    for k, curve in enumerate(curves):
        name, recalls = curve["name"], [100 * recall for recall in curve["recalls"]]
        line = "--" if name.startswith(UNTRAINED) else "-"
        color = _color(name, k)
        axes.plot(curve["ks"], recalls, linewidth=1.8, color=color, linestyle=line, label=name)
    _k_axis(axes)
    axes.set_ylim(0, 104)
    axes.set_ylabel("Recall@k (%)")
    _legend_above(figure, axes)
    figure.savefig(path)


def item_figure(
    prefix_images: Sequence[Image],
    candidate_images: Sequence[Image],
    letters: str,
    answer: str,
    chosen: str | None,
    question: str,
    path: Path | str,
) -> None:
    """One selection item: the prefix in temporal order, the question, and the candidates.

    The target has a green frame and a wrong choice a red one. `chosen` is None without an answer.
    """
    first = prefix_images[0]
    aspect = first.height / first.width
    lines, columns = (
        -(-len(prefix_images) // PREFIX_COLUMNS),
        min(len(prefix_images), PREFIX_COLUMNS),
    )
    page_width = 9.0
    title = textwrap.wrap(question, 100)
    heights = [
        0.25 + lines * page_width / columns * aspect,
        0.35 + 0.2 * len(title),
        0.3 + page_width / len(candidate_images) * aspect,
    ]
    figure = empty_figure(page_width, sum(heights))
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=heights)

    for axes in top.subplots(lines, columns, squeeze=False).flat:
        axes.set_axis_off()
    for axes, image in zip(top.axes, prefix_images, strict=False):
        axes.imshow(image)
    middle.text(0.01, 0.5, "\n".join(title), ha="left", va="center", fontsize=12, color=INK)

    panels = bottom.subplots(1, len(candidate_images), squeeze=False)[0]
    for axes, image, letter in zip(panels, candidate_images, letters, strict=True):
        axes.imshow(image)
        axes.set_xticks([])
        axes.set_yticks([])
        notes = [name for name, at in (("target", answer), ("chosen", chosen)) if letter == at]
        color = GREEN if letter == answer else RED if letter == chosen else None
        axes.set_title(
            f"{letter}  {', '.join(notes)}", fontsize=11, loc="left", color=color or INK,
            fontweight="bold" if color else "normal",
        )  # fmt: skip
        axes.spines[:].set(visible=True, edgecolor=color or FAINT, linewidth=4 if color else 0.8)
    if chosen is None:
        bottom.text(0.99, 0.99, "no answer", ha="right", va="top", fontsize=11, color=RED)
    figure.savefig(path)


def _builder_style(builder: int | None) -> dict[str, Any]:
    if builder is None:
        return {"color": INK, "linewidth": 2.6, "label": "all queries"}
    color = COLORS[(builder - 1) % len(COLORS)]
    return {"color": color, "linewidth": 1.5, "label": f"builder {builder}"}


def _plot_recalls(
    axes: Axes, points: Sequence[tuple[int, Interval]], band: bool = True, **style: Any
) -> None:
    """Recall (%) by width, with the band of its 95% interval."""
    widths = [width for width, _ in points]
    value, low, high = (
        [100 * getattr(recall, end) for _, recall in points] for end in ("value", "low", "high")
    )
    if band:
        axes.fill_between(widths, low, high, color=style["color"], alpha=0.14, linewidth=0)
    axes.plot(widths, value, **style)


def _plot_paper(axes: Axes, xs: Sequence[float], values: Sequence[float]) -> None:
    axes.scatter(
        xs, values, 60, marker="D", color="#ffffff", edgecolors=INK, linewidths=1.5,
        label=f"paper: {COT_STUDENT}, 8B",
    )  # fmt: skip


def _accuracy_axes(axes: Axes, groups: Sequence[str]) -> None:
    """Accuracy (%) by group, with a line at chance."""
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0)
    axes.set_xticks(range(len(groups)), groups)
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_ylim(0, 108)
    axes.set_yticks(range(0, 101, 25))
    axes.set_ylabel("Accuracy (%)")
    axes.spines[["top", "right"]].set_visible(False)


def _k_axis(axes: Axes) -> None:
    from matplotlib.ticker import StrMethodFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_xlabel("k")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GRID)


def _width_axis(axes: Axes, widths: Sequence[int]) -> None:
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log", base=2)
    axes.set_xticks(widths, [str(w) for w in widths], rotation=45 if len(widths) > 4 else 0)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GRID)


def _color(name: str, index: int) -> str:
    return "#999999" if name.startswith(UNTRAINED) else COLORS[index % len(COLORS)]


def _write_number(axes: Axes, x: float, y: float, value: float) -> None:
    axes.text(x, y + 1.5, f"{value:.0f}", ha="center", va="bottom", fontsize=9, color=INK)


def _escape(name: str) -> str:
    """A name in which a dollar sign does not begin a formula."""
    return name.replace("$", r"\$")


def _legend_above(figure: Figure, axes: Axes) -> None:
    """A legend above the plot, the paper's row last."""
    handles, labels = axes.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i].startswith("paper"))
    figure.legend(
        [handles[i] for i in order],
        [_escape(labels[i]) for i in order],
        loc="outside upper left",
        ncols=2,
        fontsize=9,
        frameon=False,
    )
