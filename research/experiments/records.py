"""Rows of the records of selection experiments, and accuracies with intervals.

A record has a row per test item, variant, seed and mode, with the columns family, scene_id,
item_id, answer and letter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from dynapix.data.checks.intervals import Interval
from dynapix.data.records import FAMILIES, SelectionItem
from dynapix.data.store import Store
from dynapix.evaluation.metrics.seeds import MACRO, SeedBootstrap
from dynapix.evaluation.reporting.run_responses import ItemResponse
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import OUT_OF_VIEW
from dynapix.teacher.validation.reasons import PARTS, SUPPORTED, read_response

HORIZONS = ("1s", "2s")
"""Times from the end of the prefix to the target of a time item."""


def count_claims(
    item: SelectionItem, response: ItemResponse, store: Store
) -> Iterator[tuple[str, Any]]:
    """Yield columns with what a response in reasoning mode claims (see `read_response`), and how
    many of the claims about the prefix and the prediction are about objects out of view at the cut;
    none for an item without predicates."""
    scene = store.scene(item.scene_id)
    predicates = extract_predicates(item, scene, store.scene)
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


def horizon_accuracies(table: pd.DataFrame, variant: str, mode: str) -> dict[str, Interval]:
    """Return the accuracy on time items for each of `HORIZONS` that the items have."""
    # An item's id begins with its family and its subtype, such as time-in_1s.
    horizon = table.item_id.str.extract(r"^time-in_(\ds)-", expand=False)
    if horizon.isna().all():
        return {}
    credits = credit_matrix(table[horizon.notna()].assign(family=horizon), variant, mode)
    return bootstrap(credits, HORIZONS).accuracies(variant, credits.to_numpy())


def format_cells(
    found: Mapping[str, Interval], names: Sequence[str] = (*FAMILIES, MACRO), sign: str = ""
) -> list[str]:
    """Return intervals in percent by their names, "-" for those that are not there; with the sign
    "+", they are differences."""
    return [format_percent(found[name], sign) if name in found else "-" for name in names]


def format_percent(interval: Interval, sign: str = "") -> str:
    bounds = (interval.value, interval.low, interval.high)
    value, low, high = (f"{100 * bound:{sign}.1f}" for bound in bounds)
    return f"{value} [{low}, {high}]"


def bootstrap(credits: pd.DataFrame, order: Sequence[str] = FAMILIES) -> SeedBootstrap:
    """Return the bootstrap of the items of a matrix of credits."""
    names = ("family", "scene_id")
    return SeedBootstrap(*(credits.index.get_level_values(name) for name in names), order)
