"""Figures of a report. Each function draws one and writes it to `path` in its suffix's format.

Figures are built without pyplot, so drawing leaves no global state and needs no display.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data.records import FAMILIES
from evaluation.reporting import reference as paper
from evaluation.reporting.results import RECALLS, UNTRAINED, RetrievalResult, SelectionResult
from train.common.curves import COLORS, empty_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

INK, FAINT, RIGHT, WRONG = "#333333", "#bbbbbb", "#228833", "#cc3311"
STRIP = 6
"""Prefix frames in one line of an item's figure."""
NUMBERED = 6
"""Rows at most whose bars have room for their numbers."""


def selection_figure(
    rows: Sequence[SelectionResult], path: Path | str, reference: bool = True
) -> None:
    """Bars of accuracy (%) by family with 95% Wilson whiskers, one colour a row of `rows`; the
    chance line; and, as a `reference`, the paper's reasoning student as hollow diamonds."""
    figure = empty_figure(8, 4.4)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    width = 0.84 / (len(rows) + 1)
    for i, row in enumerate(rows):
        for at, family in enumerate(FAMILIES):
            found = row.families.get(family)
            if found is None:
                continue
            x, value = at + (i - len(rows) / 2) * width, 100 * found.value
            label = f"{row.name} ({row.mode})" if family == next(iter(row.families)) else None
            axes.bar(x, value, width * 0.9, color=color_of(row.name, i), label=label)
            middle, reach = 50 * (found.high + found.low), 50 * (found.high - found.low)
            axes.errorbar(x, middle, reach, fmt="none", ecolor=INK, capsize=3, elinewidth=1.2)
            if len(rows) <= NUMBERED:
                _number(axes, x, 100 * found.high, value)
    for at, family in enumerate(FAMILIES if reference else ()):
        x, value = at + len(rows) / 2 * width, getattr(paper.COT, family)
        label = f"paper: {paper.COT.name}, 8B" if at == 0 else None
        axes.scatter(
            x, value, 60, marker="D", color="white", edgecolors=INK, linewidths=1.5, label=label
        )
        _number(axes, x, value + 1.5, value)
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0)
    axes.annotate(
        "chance", (1, 25), (4, 0), xycoords=("axes fraction", "data"), textcoords="offset points",
        va="center", fontsize=9, color=INK,
    )  # fmt: skip
    axes.set_xticks(range(len(FAMILIES)), [f.capitalize() for f in FAMILIES])
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.5, len(FAMILIES) - 0.5)
    axes.set_ylim(0, 108)
    axes.set_yticks(range(0, 101, 25))
    axes.set_ylabel("Accuracy (%)")
    legend_above(figure, axes)
    figure.savefig(path)


def retrieval_figure(rows: Sequence[RetrievalResult], path: Path | str) -> None:
    """Recall@1, @10 and @50 (%) of all queries over embedding width, one panel each, in bands of
    their 95% intervals; untrained rows are dashed.

    Rows without a width are left out.
    """
    every = (r for r in rows if r.width and r.builder is None)
    rows = sorted(every, key=lambda r: r.width)
    names = sorted({r.name for r in rows}, key=lambda name: (name.startswith(UNTRAINED), name))
    widths = sorted({r.width for r in rows})
    figure = empty_figure(9, 3.8)
    panels = figure.subplots(1, len(RECALLS), sharey=True)
    for axes, k in zip(panels, RECALLS, strict=True):
        for i, name in enumerate(names):
            points = [(r.width, r.measures[f"recall@{k}"]) for r in rows if r.name == name]
            untrained, color = name.startswith(UNTRAINED), color_of(name, i)
            across = [width for width, _ in points]
            spans = [
                [100 * found.low for _, found in points],
                [100 * found.high for _, found in points],
            ]
            axes.fill_between(across, *spans, color=color, alpha=0.15, linewidth=0)
            axes.plot(
                across,
                [100 * found.value for _, found in points],
                color=color,
                linestyle="--" if untrained else "-",
                marker="o",
                markersize=5,
                markerfacecolor="white" if untrained else None,
                linewidth=1.8,
                label=name,
                clip_on=False,
            )
        _over_widths(axes, widths)
        axes.set_title(f"Recall@{k}", fontsize=11)
    panels[0].set_ylim(0, None)
    panels[0].set_ylabel("Queries (%)")
    figure.supxlabel("Embedding width", fontsize=10)
    legend_above(figure, panels[0])
    figure.savefig(path)


def builders_figure(
    rows: Sequence[RetrievalResult], curves: Sequence[dict[str, Any]], path: Path | str
) -> None:
    """By builder, of the first retriever in `rows`: recall (%) over k at its widest width, and
    Recall@10 over width; all queries in black, with the band of their 95% interval.

    Args:
        curves: as `evaluation.metrics.breakdown.recall_curves` gives them.
    """
    from matplotlib.ticker import StrMethodFormatter

    name, widest = rows[0].name, rows[0].width
    figure = empty_figure(9, 4.2)
    left, right = figure.subplots(1, 2, sharey=True)
    for curve in reversed([c for c in curves if c["name"] == name]):
        recalls = [100 * recall for recall in curve["recalls"]]
        left.plot(curve["ks"], recalls, **_builder_style(curve["builder"]))
    own = sorted((r for r in rows if r.name == name and r.width), key=lambda r: r.width)
    for builder in reversed(list(dict.fromkeys(r.builder for r in own))):
        points = [r for r in own if r.builder == builder]
        across = [r.width for r in points]
        recalls = [100 * r.recall_10.value for r in points]
        right.plot(across, recalls, marker="o", markersize=4, **_builder_style(builder))
        if builder is None:
            spans = [[100 * getattr(r.recall_10, end) for r in points] for end in ("low", "high")]
            right.fill_between(across, *spans, color=INK, alpha=0.12, linewidth=0)
    left.set_xscale("log")
    left.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    left.set_xlabel("k")
    left.set_title(f"Recall@k at width {widest}", fontsize=11)
    left.spines[["top", "right"]].set_visible(False)
    left.grid(axis="y", color="#eeeeee")
    _over_widths(right, sorted({r.width for r in own}))
    right.set_xlabel("Embedding width")
    right.set_title("Recall@10", fontsize=11)
    left.set_ylim(0, None)
    left.set_ylabel("Queries (%)")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(
        handles[::-1], labels[::-1], loc="outside right center", fontsize=9, frameon=False,
        title=literal(textwrap.fill(name, 18)), title_fontsize=9,
    )  # fmt: skip
    figure.savefig(path)


def _builder_style(builder: int | None) -> dict[str, Any]:
    if builder is None:
        return {"color": INK, "linewidth": 2.6, "label": "all queries"}
    color = COLORS[(builder - 1) % len(COLORS)]
    return {"color": color, "linewidth": 1.5, "label": f"builder {builder}"}


def _over_widths(axes: Axes, widths: Sequence[int]) -> None:
    """A panel whose x axis is the embedding's width."""
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log", base=2)
    axes.set_xticks(widths, [str(w) for w in widths], rotation=45 if len(widths) > 4 else 0)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#eeeeee")


def item_figure(
    prefix_images: Sequence[Image],
    candidate_images: Sequence[Image],
    letters: str,
    answer: str,
    chosen: str | None,
    question: str,
    path: Path | str,
) -> None:
    """One selection item: the prefix in order of time, the question, and the candidates below.

    The target is framed green, a wrong choice red; `chosen` is None where there was no answer.
    """
    images = [*prefix_images, *candidate_images]
    height_share = images[0].height / images[0].width
    lines = -(-len(prefix_images) // STRIP)
    across = min(len(prefix_images), STRIP)
    page, wide = 9.0, 9.0 / len(candidate_images)
    title = textwrap.wrap(question, 100)
    heights = [
        0.25 + lines * page / across * height_share,
        0.35 + 0.2 * len(title),
        0.3 + wide * height_share,
    ]
    figure = empty_figure(page, sum(heights))
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=heights)

    for axes in top.subplots(lines, across, squeeze=False).flat:
        axes.set_axis_off()
    for axes, image in zip(top.axes, prefix_images, strict=False):
        axes.imshow(image)
    middle.text(0.01, 0.5, "\n".join(title), ha="left", va="center", fontsize=12, color=INK)

    panels = bottom.subplots(1, len(candidate_images), squeeze=False)[0]
    for axes, image, letter in zip(panels, candidate_images, letters, strict=True):
        axes.imshow(image)
        axes.set_xticks([])
        axes.set_yticks([])
        notes = [n for n, holds in (("target", answer), ("chosen", chosen)) if letter == holds]
        color = RIGHT if letter == answer else WRONG if letter == chosen else None
        axes.set_title(
            f"{letter}  {', '.join(notes)}", fontsize=11, loc="left", color=color or INK,
            fontweight="bold" if color else "normal",
        )  # fmt: skip
        axes.spines[:].set(visible=True, edgecolor=color or FAINT, linewidth=4 if color else 0.8)
    if chosen is None:
        bottom.text(0.99, 0.99, "no answer", ha="right", va="top", fontsize=11, color=WRONG)
    figure.savefig(path)


def color_of(name: str, index: int) -> str:
    return "#999999" if name.startswith(UNTRAINED) else COLORS[index % len(COLORS)]


def _number(axes: Axes, x: float, y: float, value: float) -> None:
    axes.text(x, y + 1.5, f"{value:.0f}", ha="center", va="bottom", fontsize=9, color=INK)


def literal(name: str) -> str:
    """A name as text to draw, in which a dollar sign begins no formula."""
    return name.replace("$", r"\$")


def legend_above(figure: Figure, axes: Axes) -> None:
    """A legend above the plot, where it covers nothing."""
    handles, labels = axes.get_legend_handles_labels()
    # Markers are listed before bars, whatever the order they were drawn in: keep the paper last.
    order = sorted(range(len(labels)), key=lambda i: labels[i].startswith("paper"))
    figure.legend(
        [handles[i] for i in order],
        [literal(labels[i]) for i in order],
        loc="outside upper left",
        ncols=2,
        fontsize=9,
        frameon=False,
    )
