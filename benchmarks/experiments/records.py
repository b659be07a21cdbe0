"""Rows of the records of selection experiments, and accuracies with intervals.

A record has a row per test item, variant, seed and mode, with the columns family, scene_id,
item_id, answer and letter.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from conf.schema import RelationBounds
from data.records import FAMILIES, SelectionItem
from data.store import Store
from evaluation.reporting.run_responses import ItemResponse
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import OUT_OF_VIEW
from teacher.validation.reasons import PARTS, SUPPORTED, read_response

HORIZONS = ("1s", "2s")
"""Times from the end of the prefix to the target of a time item."""
DRAWS = 4000
"""Number of bootstrap samples."""


def count_claims(
    item: SelectionItem, response: ItemResponse, store: Store
) -> Iterator[tuple[str, Any]]:
    """Yield columns with what a response in reasoning mode claims (see `read_response`), and how
    many of the claims about the prefix and the prediction are about objects out of view at the cut;
    none for an item without predicates."""
    scene = store.scene(item.scene_id)
    predicates = extract_predicates(item, scene, store.scene, RelationBounds())
    if predicates is None:
        return
    reasons = read_response(response.text, response.letter, item.letter, predicates)
    for part in PARTS:
        claims = reasons.claims[part]
        yield f"{part}_claims", len(claims)
        yield f"{part}_supported", sum(c.verdict == SUPPORTED for c in claims)
    unseen = {o.object for o in predicates.objects if o.sight == OUT_OF_VIEW}
    about_scene = [*reasons.claims["prefix"], *reasons.claims["prediction"]]
    yield "unseen_claims", sum(not unseen.isdisjoint(c.subjects) for c in about_scene)
    yield "follows", reasons.follows
    yield "true_reasons", reasons.true


def credit_matrix(table: pd.DataFrame, variant: str, mode: str) -> pd.DataFrame:
    """Return 1 for each right answer and 0 for each wrong one, (items, seeds)."""
    rows = table[(table.variant == variant) & (table["mode"] == mode)]
    credits = (rows.letter == rows.answer).astype(float)
    return credits.groupby([rows.family, rows.scene_id, rows.item_id, rows.seed]).sum().unstack()


def horizon_intervals(
    table: pd.DataFrame, variant: str, mode: str
) -> list[tuple[float, float, float]]:
    """Return the mean accuracy on time items and the bounds of its interval, in percent, for each
    of `HORIZONS`."""
    # An item's id begins with its family and its subtype, such as time-in_1s.
    horizon = table.item_id.str.extract(r"^time-in_(\ds)-", expand=False)
    credits = credit_matrix(table[horizon.notna()].assign(family=horizon), variant, mode)
    return Resampling(credits.index, HORIZONS).intervals((variant, credits))[: len(HORIZONS)]


class Resampling:
    """A bootstrap over scenes and seeds of the accuracy in each family and their mean, the macro.

    All results share the resampled scenes, and those of the same trained students the resampled
    seeds. The seeds of different variants are resampled independently, since runs of two variants
    with the same seed have nothing in common but its number.
    """

    def __init__(self, items: pd.MultiIndex, families: Sequence[str] = FAMILIES) -> None:
        family_of_item = items.get_level_values("family")
        self._scene, scenes = pd.factorize(items.get_level_values("scene_id"))
        self._members = [family_of_item == family for family in families]
        share = np.full(len(scenes), 1 / len(scenes))
        # (draws, scenes) how often each draw contains each scene.
        weights = np.random.default_rng(0).multinomial(len(scenes), share, size=DRAWS)
        self._weights = weights.astype(float)

    def means(self, credits: pd.DataFrame) -> np.ndarray:
        """Return (families + 1,) means over all items and seeds: of each family, and the macro."""
        means = [credits[members].to_numpy().mean() for members in self._members]
        return np.array([*means, np.mean(means)])

    def intervals(
        self, first: tuple[str, pd.DataFrame], second: tuple[str, pd.DataFrame] | None = None
    ) -> list[tuple[float, float, float]]:
        """Return the mean and the bounds of its interval, in percent, for each family and the macro
        of `first`, or of the difference `first` minus `second`. Both are a variant and its credits.
        """
        means, draws = self.means(first[1]), self._draws(*first)
        if second is not None:
            means, draws = means - self.means(second[1]), draws - self._draws(*second)
        low, high = np.percentile(draws, [2.5, 97.5], axis=0)
        return [tuple(100 * np.array(t)) for t in zip(means, low, high, strict=True)]

    def _draws(self, variant: str, credits: pd.DataFrame) -> np.ndarray:
        """Return the means of each draw, (draws, families + 1)."""
        seeds = credits.shape[1]
        rng = np.random.default_rng([0, zlib.crc32(variant.encode())])
        seed_shares = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=DRAWS) / seeds
        means = []
        for members in self._members:
            sums = np.zeros((self._weights.shape[1], seeds))
            np.add.at(sums, self._scene[members], credits[members].to_numpy())
            counts = np.bincount(self._scene[members], minlength=len(sums))
            totals = ((self._weights @ sums) * seed_shares).sum(axis=1)
            means.append(totals / (self._weights @ counts))
        return np.column_stack([*means, np.mean(means, axis=0)])
