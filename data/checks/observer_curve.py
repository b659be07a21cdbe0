"""The accuracy of observers over their error, and the error to which an accuracy corresponds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import exp, inf, log
from pathlib import Path
from textwrap import fill
from types import MappingProxyType
from typing import IO, Any, Self

import numpy as np
import pandas as pd

from dynapix.data.checks.figures import COLORS, GRID, INK, create_figure, legend_above
from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.checks.observer import DRAWS, ERRORS, SIMULATES
from dynapix.data.checks.statistics import list_categories
from dynapix.data.items.recipes import TIME_CELLS
from dynapix.data.records import SelectionItem

CEILING_ERROR = 1.0
"""Error in px of the observer whose chance of being right is the ceiling of an item."""
GUESS = 0.25
"""Chance of a random choice."""
EVERY = "all"
"""Name of the group of all items."""
NAMED = 5
"""Maximum number of ids of unsolvable items that are printed."""


@dataclass(frozen=True)
class ObserverError:
    """The error of the observer that is as accurate as a model, px at 336 x 336, with the interval
    that follows from the accuracy's. 0 stands for less than the least of `ERRORS`, and infinity for
    more than the largest."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        value, low, high = map(_format, (self.value, self.low, self.high))
        return value if low == high else f"{value} [{low}, {high}]"


def _format(error: float) -> str:
    if error == 0:
        return f"< {ERRORS[0]:g}"
    return f"> {ERRORS[-1]:g}" if error == inf else f"{error:.2g}"


@dataclass(frozen=True)
class ObserverCurve:
    """The accuracy of an observer on some items by error (px at 336 x 336), 0 first."""

    accuracy: Mapping[float, Interval]

    @classmethod
    def from_shares(cls, shares: pd.DataFrame, scenes: Sequence[str], seed: int) -> Self:
        """Return the curve over the items whose results these are (see `observe_benchmark`), which
        have these scenes. `seed` is that of the resampling of scenes."""
        bootstrap = SceneBootstrap(scenes, seed)
        return cls({float(error): bootstrap.mean(shares[error]) for error in shares})

    def error_of(self, accuracy: Interval) -> ObserverError:
        """Return the error of the observer with an accuracy over all of these items. Its interval
        is that of the accuracy: the curve is measured on the same items, with many draws."""
        return ObserverError(*map(self._invert, (accuracy.value, accuracy.high, accuracy.low)))

    def _invert(self, accuracy: float) -> float:
        """Return the largest error with which the observer is at least as accurate. The curve is
        replaced by the nearest one that nowhere rises, and is linear over the error's logarithm."""
        from scipy.optimize import isotonic_regression

        measured = [self.accuracy[error].value for error in ERRORS]
        falling = isotonic_regression(measured, increasing=False).x
        # The margin is for the rounding of means.
        reached = int((falling >= accuracy - 1e-9).sum())
        if reached == 0:
            return 0.0
        if reached == len(ERRORS):
            return inf
        above, below = falling[reached - 1 : reached + 1]
        near, far = map(log, ERRORS[reached - 1 : reached + 1])
        share = min(max((above - accuracy) / (above - below), 0.0), 1.0)
        return exp(near + share * (far - near))


def observer_curves(
    results: Mapping[str, pd.DataFrame], items: Sequence[SelectionItem], seed: int
) -> dict[str, ObserverCurve]:
    """Return the curve of each observer on some of the items that it has seen."""
    ids, scenes = [i.item_id for i in items], [i.scene_id for i in items]
    return {
        observer: ObserverCurve.from_shares(shares.loc[ids], scenes, seed)
        for observer, shares in results.items()
    }


def summarize_observers(
    results: Mapping[str, pd.DataFrame], items: Sequence[SelectionItem], seed: int
) -> dict[str, Any]:
    """Return as plain values: ``curves``, the accuracy with its interval by observer, group of
    items (all, family, kind of distractors, difficulty, horizon) and error; and ``ceilings``, the
    chance by item of the observer that simulates with an error of `CEILING_ERROR`."""
    groups: dict[str, list[SelectionItem]] = {}
    for item in items:
        for name in _groups(item):
            groups.setdefault(name, []).append(item)
    curves: dict[str, dict[str, dict[str, dict[str, float]]]] = {name: {} for name in results}
    # Shorter names first, so that 8 frames come before 16.
    for group in sorted(groups, key=lambda n: (n.partition(",")[0], len(n), n)):
        for observer, curve in observer_curves(results, groups[group], seed).items():
            curves[observer][group] = {f"{e:g}": vars(i) for e, i in curve.accuracy.items()}
    return {"curves": curves, "ceilings": results[SIMULATES][CEILING_ERROR].to_dict()}


def _groups(item: SelectionItem) -> Iterator[str]:
    yield EVERY
    yield from list_categories(item)
    if item.family == "time":
        yield f"time, {TIME_CELLS[item.subtype]} s"
    elif frames := item.gap or item.horizon:
        yield f"{item.family}, {frames} frames"


def format_observers(summary: Mapping[str, Any]) -> str:
    """Format the curves as text tables, with intervals of the accuracies over all items, and count
    the items that the observer with an error of `CEILING_ERROR` does not solve."""
    sections = []
    for observer, by_group in summary["curves"].items():
        rows = {}
        for group, curve in by_group.items():
            rows[group] = {e: f"{100 * i['value']:.1f}" for e, i in curve.items()}
            rows[group]["items"] = next(iter(curve.values()))["n"]
            if group == EVERY:
                bounds = {e: (100 * i["low"], 100 * i["high"]) for e, i in curve.items()}
                rows["  95% interval"] = {e: f"{a:.0f}-{b:.0f}" for e, (a, b) in bounds.items()}
        table = pd.DataFrame(rows).T.fillna("").to_string()
        sections.append(
            f"Accuracy of the observer that {observer}, by its error in px at 336 x 336, %\n{table}"
        )
    ceilings = summary["ceilings"]
    low = [name for name, chance in ceilings.items() if chance <= GUESS]
    named = f" ({', '.join(low[:NAMED])}{', ...' * (len(low) > NAMED)})" if low else ""
    unsolvable = (
        f"Unsolvable for eyes with an error of {CEILING_ERROR:g} px, with which the observer that "
        f"simulates is right in at most a quarter of its {DRAWS} draws: {len(low)} of "
        f"{len(ceilings)} items{named}"
    )
    sections.append(fill(unsolvable, 100))
    return "\n\n".join(sections)


def plot_observers(
    curves: Mapping[str, ObserverCurve],
    file: Path | IO[bytes],
    models: Mapping[str, Interval] = MappingProxyType({}),
) -> None:
    """Plot accuracies (%) over the errors of observers, with 95% intervals as bands.

    Args:
        curves: The curve of each observer, by its name.
        models: Accuracies of models on the same items, by label. Each is marked where it meets the
            curve of the observer that simulates, or at the border if it lies beyond the curve.
    """
    figure = create_figure(8, 4.4)
    axes = figure.add_subplot()
    for (observer, curve), color in zip(curves.items(), COLORS, strict=False):
        accuracies = [curve.accuracy[error] for error in ERRORS]
        value, low, high = 100 * np.array([(a.value, a.low, a.high) for a in accuracies]).T
        axes.fill_between(ERRORS, low, high, color=color, alpha=0.14, linewidth=0)
        axes.plot(ERRORS, value, "-o", color=color, markersize=4, label=f"observer that {observer}")
    for k, (label, accuracy) in enumerate(models.items()):
        error = curves[SIMULATES].error_of(accuracy).value
        place = {0: ERRORS[0], inf: ERRORS[-1]}.get(error, error)
        value, low, high = (100 * x for x in (accuracy.value, accuracy.low, accuracy.high))
        color, marker = COLORS[(2 + k) % len(COLORS)], "DsvP^X"[k % 6]
        axes.errorbar(
            place, value, [[value - low], [high - value]], fmt=marker, color=color, capsize=3,
            label=label,
        )  # fmt: skip
    axes.axhline(25, color=INK, linestyle="--", linewidth=1, zorder=0, label="chance")
    axes.set_xscale("log", base=2)
    axes.set_xticks(ERRORS, [f"{error:g}" for error in ERRORS])
    axes.set(xlabel="Error of the observer (px at 336 x 336)", ylabel="Accuracy (%)", ylim=(0, 103))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GRID)
    legend_above(figure, axes)
    figure.savefig(file)
