"""Selection results: the accuracies of a model's choices, and the details of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from dynapix.conf.schema.benchmark import INTERVENTIONS, MATCHED_ANCHOR
from dynapix.data.checks.baselines import score_baselines
from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.items.controls import pair_items
from dynapix.data.items.recipes import TIME_CELLS
from dynapix.data.records import SelectionItem
from dynapix.evaluation.metrics.reasons import ReasonSummary
from dynapix.evaluation.metrics.results import (
    BASELINE,
    SIMILARITY,
    SelectionReport,
    SelectionResult,
    accuracy_by_family,
)
from dynapix.evaluation.metrics.significance import (
    PairedComparison,
    PairScores,
    compare_anchors,
    compare_runs,
    score_pairs,
)

if TYPE_CHECKING:
    from dynapix.data.store import Store
    from dynapix.evaluation.generators.response_log import Answer
    from dynapix.evaluation.reporting.run_responses import ItemResponse

BASELINES = {
    "nearest": "nearest to the last observed frame",
    "odd": "odd one out",
    "first": "first candidate",
    "latest": "latest candidate",
    "velocity": "constant velocity to the target's moment",
}
"""Name in tables of each reported baseline. Only `velocity` predicts, and it knows the moment."""


@dataclass(frozen=True)
class Choices:
    """The choices of a model for all items, in one mode and under one control.

    Attributes:
        credits: For each item, 1 for a correct choice, 1/m if the target is one of m candidates
            with the highest score, and 0 otherwise.
        letters: The chosen letters; None for a tie or a response that cannot be parsed.
        answers: The responses of a student to the items; empty for a retriever.
    """

    name: str
    mode: str
    control: str | None
    credits: Sequence[float]
    letters: Sequence[str | None]
    answers: Sequence[Answer] = ()

    @classmethod
    def from_answers(
        cls, name: str, mode: str, control: str | None, answers: Sequence[Answer]
    ) -> Choices:
        credits = [float(answer.right) for answer in answers]
        return cls(name, mode, control, credits, [a.letter for a in answers], answers)

    @classmethod
    def from_scores(
        cls, name: str, responses: Sequence[ItemResponse], items: Sequence[SelectionItem]
    ) -> Choices:
        """Return the choices of a retriever, which `nearest_candidates` returned for its scores."""
        credits = [r.credit(item.letter) for r, item in zip(responses, items, strict=True)]
        return cls(name, SIMILARITY, None, credits, [r.letter for r in responses])


def build_selection_report(
    choices: Sequence[Choices],
    items: Sequence[SelectionItem],
    store: Store,
    seed: int,
    suite: str | None = None,
    asked: Sequence[tuple[str, str | None, str]] = (),
    reasons: Mapping[str, ReasonSummary] = MappingProxyType({}),
) -> SelectionReport:
    """Return the report of the choices of one or several models on the same items.

    Args:
        store: The benchmark of the items.
        seed: Seed of the resampling of scenes.
        suite: As in `SelectionResult`.
        asked, reasons: As in `SelectionReport`.
    """
    scenes = SceneBootstrap([i.scene_id for i in items], seed)
    results = [_selection_result(c, items, scenes, store.name, suite) for c in choices]
    by_key = {result.key: c for result, c in zip(results, choices, strict=True)}
    subtypes = [f"{i.family}/{i.subtype}" for i in items]
    return SelectionReport(
        store.identity,
        results,
        controls=_compare_controls(by_key, items, seed),
        subtypes={key: scenes.group_means(c.credits, subtypes) for key, c in by_key.items()},
        readings={key: count_readings(c.answers) for key, c in by_key.items() if c.answers},
        reasons={**reasons},
        asked=[*asked],
        pairs=_score_interventions(by_key, items, seed),
    )


def _score_interventions(
    choices: Mapping[str, Choices], items: Sequence[SelectionItem], seed: int
) -> dict[str, list[PairScores]]:
    """Return the scores of pairs about interventions; none for other items."""
    if items[0].suite != INTERVENTIONS or not pair_items(items):
        return {}
    ids = [item.item_id for item in items]
    return {
        key: score_pairs(
            items,
            dict(zip(ids, c.credits, strict=True)),
            dict(zip(ids, c.letters, strict=True)),
            seed,
        )
        for key, c in choices.items()
    }


def baseline_results(
    items: Sequence[SelectionItem], store: Store, seed: int
) -> list[SelectionResult]:
    """Return the accuracies of the baselines on items. `seed` is that of the resampling."""
    scores = [score_baselines(item, store) for item in items]
    letters = [None] * len(items)
    choices = [
        Choices(title, BASELINE, None, [s[name] for s in scores], letters)
        for name, title in BASELINES.items()
        if not np.isnan([s[name] for s in scores]).any()
    ]
    return build_selection_report(choices, items, store, seed).rows


def _selection_result(
    choices: Choices,
    items: Sequence[SelectionItem],
    scenes: SceneBootstrap,
    benchmark: str,
    suite: str | None,
) -> SelectionResult:
    accuracy = accuracy_by_family([i.family for i in items], choices.credits, scenes)
    parse_rate = None
    if choices.mode not in (BASELINE, SIMILARITY):
        parse_rate = sum(x is not None for x in choices.letters) / len(items)
    return SelectionResult(
        benchmark,
        choices.name,
        choices.mode,
        **vars(accuracy),
        parse_rate=parse_rate,
        n=len(items),
        horizons=accuracy_by_horizon(items, choices.credits, scenes),
        suite=suite,
        control=choices.control,
    )


def accuracy_by_horizon(
    items: Sequence[SelectionItem], credits: Sequence[float], scenes: SceneBootstrap
) -> dict[str, Interval]:
    """Return the mean credit of the items of each horizon, shortest first."""
    by_horizon = scenes.group_means(credits, [horizon_of(item) or "" for item in items])
    return {h: by_horizon[h] for h in sorted(filter(None, by_horizon), key=horizon_order)}


def horizon_of(item: SelectionItem) -> str | None:
    """Return the horizon in seconds (time family) or in frames (window family), else None."""
    if item.family == "time":
        return f"{TIME_CELLS[item.subtype]} s"
    return f"{item.horizon} frames" if item.family == "window" else None


def horizon_order(horizon: str) -> tuple[bool, float]:
    """Return the key by which horizons are sorted: those in frames come first."""
    return horizon.endswith(" s"), float(horizon.split()[0])


def count_readings(answers: Sequence[Answer]) -> dict[str, int]:
    """Count parsed responses, valid records if the mode requests them, and the others by reason."""
    counts = {"with a letter": sum(a.letter is not None for a in answers)}
    if answers[0].valid is not None:
        counts["  in a valid record"] = sum(a.valid for a in answers)
    reasons = Counter(f"without: {a.reason}" for a in answers if a.letter is None)
    return counts | dict(reasons.most_common())


def _compare_controls(
    choices: Mapping[str, Choices], items: Sequence[SelectionItem], seed: int
) -> list[PairedComparison]:
    """Compare the choices without a control with those under each control, and, for matched-anchor
    items, the choices for the two questions of each pair."""
    ids = [item.item_id for item in items]
    credits = {key: dict(zip(ids, c.credits, strict=True)) for key, c in choices.items()}
    compared = []
    for key, c in choices.items():
        if c.control is not None:
            pair, names = (credits[c.mode], credits[key]), ("unchanged", c.control)
            differences = compare_runs(items, *pair, names, seed)
            compared += [replace(p, mode=c.mode) for p in differences]
        if items[0].suite == MATCHED_ANCHOR:
            differences = compare_anchors(items, credits[key], seed)
            compared += [replace(p, mode=key) for p in differences]
    return compared
