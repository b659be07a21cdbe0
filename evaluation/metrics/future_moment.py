"""Accuracy on balanced time items, split into the future and the moment of the chosen candidates.

The candidates of such an item are two futures at two moments. Two of them show the true future, two
the true moment, and only the target shows both. A model may predict the motion and miss the moment,
or choose the right moment of a wrong future.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.oracle.displacement import cross_scene_displacement
from dynapix.data.records import LETTERS, Candidate, Scene, SelectionItem
from dynapix.evaluation.metrics.selection import horizon_of, horizon_order

BAND_EDGES = (24, 48, 96)
BANDS = ("below 24 px", "24 to 48 px", "48 to 96 px", "96 px or more")
"""Bands of displacements (px at 336 x 336), and the displacements at which they begin and end."""


@dataclass(frozen=True)
class Shares:
    """Shares of the items whose answer is the target, shows the true future, and shows the true
    moment. An answer without a letter shows neither."""

    accuracy: Interval
    future: Interval
    moment: Interval


@dataclass(frozen=True)
class FutureMoment:
    """The shares of a model over the balanced time items.

    Attributes:
        horizons: By horizon (time from the prefix to the target), shortest first, such as "1 s".
        future_bands: The share with the true future, by the displacement between the two futures at
            the true moment.
        moment_bands: The share with the true moment, by the displacement between the two moments of
            the true future.
    """

    total: Shares
    horizons: dict[str, Shares]
    future_bands: dict[str, Interval]
    moment_bands: dict[str, Interval]


def measure_future_moment(
    items: Sequence[SelectionItem],
    letters: Mapping[str, Mapping[str, str]],
    scene_of: Callable[[str], Scene],
    seed: int,
) -> dict[str, FutureMoment]:
    """Return the shares of each model that answered all balanced time items among `items`; none if
    there are no such items.

    Args:
        items: All items of an evaluation: their scenes are resampled, as for the accuracy.
        letters: The chosen letter by model and item id: several letters for tied scores, which
            share the answer, and none for a response that cannot be parsed.
        seed: Seed of the resampling.
    """
    measured = [item if has_two_futures(item) else None for item in items]
    if not any(measured):
        return {}
    scenes = SceneBootstrap([item.scene_id for item in items], seed)
    every = ["all" if item else "" for item in measured]
    horizons = [horizon_of(item) if item else "" for item in measured]
    ordered = sorted({*horizons} - {""}, key=horizon_order)
    bands = [_bands(item, scene_of) if item else ("", "") for item in measured]
    future_bands, moment_bands = zip(*bands, strict=True)

    def measure(chosen: Mapping[str, str]) -> FutureMoment:
        credits = [_credits(i, chosen[i.item_id]) if i else (0, 0, 0) for i in measured]
        accuracy, future, moment = np.transpose(credits)

        def shares(groups: Sequence[str]) -> dict[str, Shares]:
            parts = [scenes.group_means(part, groups) for part in (accuracy, future, moment)]
            return {name: Shares(*(part[name] for part in parts)) for name in parts[0]}

        by_horizon = shares(horizons)
        by_future = scenes.group_means(future, future_bands)
        by_moment = scenes.group_means(moment, moment_bands)
        return FutureMoment(
            shares(every)["all"],
            {horizon: by_horizon[horizon] for horizon in ordered},
            {band: by_future[band] for band in BANDS if band in by_future},
            {band: by_moment[band] for band in BANDS if band in by_moment},
        )

    return {
        name: measure(chosen)
        for name, chosen in letters.items()
        if all(item.item_id in chosen for item in measured if item)
    }


def has_two_futures(item: SelectionItem) -> bool:
    """Return whether the candidates of a time item show two futures at two moments."""
    shown = {_shows(item, candidate) for candidate in item.candidates}
    return item.family == "time" and shown == {*product((True, False), repeat=2)}


def _shows(item: SelectionItem, candidate: Candidate) -> tuple[bool, bool]:
    """Return whether a candidate shows the true future, and whether it shows the true moment."""
    return candidate.scene_id == item.scene_id, candidate.frame == item.target_frame


def _credits(item: SelectionItem, letters: str) -> np.ndarray:
    """Return the credit (3,) of the chosen letters for the target, the future and the moment."""
    shown = [_shows(item, item.candidates[LETTERS.index(letter)]) for letter in letters]
    return np.mean([(all(s), *s) for s in shown] or [(0, 0, 0)], axis=0)


def _bands(item: SelectionItem, scene_of: Callable[[str], Scene]) -> tuple[str, str]:
    """Return the bands of the displacements from the target to the other future at its moment, and
    to the other moment of its future."""
    by_shown = {_shows(item, candidate): candidate for candidate in item.candidates}
    own = scene_of(item.scene_id)
    displacements = (
        cross_scene_displacement(own, item.target_frame, scene_of(other.scene_id), other.frame)
        for other in (by_shown[False, True], by_shown[True, False])
    )
    other_future, other_moment = (BANDS[bisect(BAND_EDGES, d)] for d in displacements)
    return other_future, other_moment
