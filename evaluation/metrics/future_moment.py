"""Accuracy on balanced time items, split into the future and the moment of the chosen candidates.

The candidates of such an item are two futures at two moments. Two of them show the true future, two
the true moment, and only the target shows both. A model may predict the motion and miss the moment,
or choose the right moment of a wrong future.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.records import LETTERS, Candidate, SelectionItem
from dynapix.evaluation.metrics.selection import horizon_of, horizon_order


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
    """

    total: Shares
    horizons: dict[str, Shares]


def measure_future_moment(
    items: Sequence[SelectionItem],
    letters: Mapping[str, Mapping[str, str]],
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

    def measure(chosen: Mapping[str, str]) -> FutureMoment:
        credits = [_credits(i, chosen[i.item_id]) if i else (0, 0, 0) for i in measured]
        accuracy, future, moment = np.transpose(credits)

        def shares(groups: Sequence[str]) -> dict[str, Shares]:
            parts = [scenes.group_means(part, groups) for part in (accuracy, future, moment)]
            return {name: Shares(*(part[name] for part in parts)) for name in parts[0]}

        by_horizon = shares(horizons)
        ordered_shares = {horizon: by_horizon[horizon] for horizon in ordered}
        return FutureMoment(shares(every)["all"], ordered_shares)

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
