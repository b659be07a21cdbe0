"""The report's figures that evaluation.reporting.figures does not draw for single runs, and how
any figure
gets into the page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from data.records import LETTERS
from evaluation.metrics.intervals import Interval, wilson_interval
from evaluation.reporting import reference as paper
from evaluation.reporting.figures import FAINT, INK, color_of, legend_above, literal
from evaluation.reporting.results import UNTRAINED
from train.common.curves import COLORS, empty_figure

HORIZONS = {"time/in_1s": "1 s", "time/in_2s": "2 s"}
"""Subtypes of the time family by what they ask for."""
WINDOW = re.compile(r"window/.*_h(\d+)_")
"""Subtypes of the window family, whose horizon is in frames."""
NO_LETTER = "none"
ON_PAGE = {
    "#ffffff": "var(--card)",
    "#000000": "currentColor",
    INK: "currentColor",
    FAINT: "var(--soft)",
    "#eeeeee": "var(--line)",
}
"""Colours of a figure that follow the page's, light or dark."""


def by_horizon(subtypes: Mapping[str, Interval]) -> dict[str, Interval]:
    """Accuracy of a run's subtypes over how far ahead they ask: 1 s and 2 s of the time family, and
    frames of the window family, nearest first, with Wilson's intervals."""
    hits: dict[str, list[float]] = {}
    for cell, found in subtypes.items():
        window = WINDOW.match(cell)
        horizon = f"{window[1]} frames" if window else HORIZONS.get(cell)
        if horizon is not None:
            right, n = hits.get(horizon, (0.0, 0))
            hits[horizon] = (right + found.value * found.n, n + found.n)
    return {
        horizon: Interval(right / n, *wilson_interval(right, n), n)
        for horizon, (right, n) in sorted(hits.items(), key=lambda found: _how_far(found[0]))
    }


def _how_far(horizon: str) -> tuple[bool, int]:
    """What sorts horizons, nearest first: the window family's frames are all less than a second."""
    return horizon.endswith(" s"), int(horizon.split()[0])


def horizon_figure(
    found: Mapping[str, Mapping[str, Interval]], path: Path, reference: bool = True
) -> None:
    """Accuracy (%) by horizon, one color a model, with 95% whiskers; the chance line; and, as a
    `reference`, the paper's reasoning student 1 s and 2 s ahead as hollow diamonds."""
    horizons = sorted({horizon for of in found.values() for horizon in of}, key=_how_far)
    figure = empty_figure(7, 4.2)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    for k, (name, of) in enumerate(found.items()):
        xs = [i + (k - (len(found) - 1) / 2) * 0.08 for i, h in enumerate(horizons) if h in of]
        values = np.array([100 * of[h].value for h in horizons if h in of])
        spans = np.array([[100 * of[h].low, 100 * of[h].high] for h in horizons if h in of])
        axes.errorbar(
            xs, values, np.abs(spans.T - values), fmt="o", color=COLORS[k % len(COLORS)],
            capsize=3, markersize=6, elinewidth=1.2, label=name,
        )  # fmt: skip
    paper_s = {f"{s} s": value for s, value in paper.TIME_BY_HORIZON[paper.COT.name].items()}
    places = [(i, paper_s[h]) for i, h in enumerate(horizons) if h in paper_s]
    if places and reference:
        axes.scatter(
            *zip(*places, strict=True), 60, marker="D", color="#ffffff", edgecolors=INK,
            linewidths=1.5, label=f"paper: {paper.COT.name}, 8B",
        )  # fmt: skip
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0)
    axes.set_xticks(range(len(horizons)), horizons)
    axes.set_xlim(-0.5, len(horizons) - 0.5)
    axes.set_ylim(0, 104)
    axes.set_yticks(range(0, 101, 25))
    axes.set_ylabel("Accuracy (%)")
    legend_above(figure, axes)
    figure.savefig(path)


def recall_figure(curves: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Recall (%) over k of all queries, one line a retriever at its widest; untrained ones are
    dashed.

    Args:
        curves: as `evaluation.metrics.breakdown.recall_curves` gives them, of all queries.
    """
    from matplotlib.ticker import StrMethodFormatter

    figure = empty_figure(7, 4.2)
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    for k, curve in enumerate(curves):
        name, recalls = curve["name"], [100 * recall for recall in curve["recalls"]]
        line = "--" if name.startswith(UNTRAINED) else "-"
        color = color_of(name, k)
        axes.plot(curve["ks"], recalls, linewidth=1.8, color=color, linestyle=line, label=name)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.grid(axis="y", color="#eeeeee")
    axes.set_xlabel("k")
    axes.set_ylim(0, 104)
    axes.set_ylabel("Recall@k (%)")
    legend_above(figure, axes)
    figure.savefig(path)


def confusion(pairs: Sequence[tuple[str, str | None]]) -> np.ndarray:
    """(4, 5) counts of (right letter, chosen letter or None); a choice that could not be read is in
    the last column."""
    counts = np.zeros((len(LETTERS), len(LETTERS) + 1), int)
    for right, chosen in pairs:
        counts[LETTERS.index(right), len(LETTERS) if chosen is None else LETTERS.index(chosen)] += 1
    return counts


def confusion_figure(found: Mapping[str, np.ndarray], path: Path) -> None:
    """Which letter was chosen where each was right, as shares (%) of a row's items, one panel a
    model."""
    across = min(3, len(found))
    down = -(-len(found) // across)
    figure = empty_figure(2.9 * max(2, across), 2.9 * down)
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    for axes, (name, counts) in zip(panels, found.items(), strict=False):
        shares = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        for (i, j), share in np.ndenumerate(shares):
            # Drawn as squares: an image would be pixels, and its white would not follow the page.
            color = COLORS[0] if i == j else COLORS[1]
            square = [
                (j - 0.48, i - 0.48),
                (j + 0.48, i - 0.48),
                (j + 0.48, i + 0.48),
                (j - 0.48, i + 0.48),
            ]
            axes.fill(
                *zip(*square, strict=True), color=color, alpha=0.85 * share / 100, linewidth=0
            )
            axes.text(j, i, f"{share:.0f}", ha="center", va="center", fontsize=10, color=INK)
        axes.set_xticks(range(len(LETTERS) + 1), [*LETTERS, NO_LETTER])
        axes.set_yticks(range(len(LETTERS)), LETTERS)
        axes.set_xlim(-0.5, len(LETTERS) + 0.5)
        axes.set_ylim(len(LETTERS) - 0.5, -0.5)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_title(literal(name if len(name) < 34 else f"{name[:32]}…"), fontsize=9)
        axes.set_xlabel("chosen", fontsize=9)
        axes.set_ylabel("right", fontsize=9)
    figure.savefig(path)


def inlined(path: Path, number: int) -> str:
    """An SVG file as an element of the page, in the page's own text and colours; `number` keeps its
    names apart from those of the page's other figures."""
    svg = path.read_text(encoding="utf-8")
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>f{number}-", svg)
    for fixed, follows in ON_PAGE.items():
        svg = svg.replace(fixed, follows)
    return svg
