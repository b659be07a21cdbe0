"""Selection accuracies of the baselines, as rows of the report's tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynapix.data.checks.baselines import score_baselines
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.evaluation.metrics.results import BASELINE, SelectionResult
from dynapix.evaluation.metrics.selection import Choices, build_selection_report

TITLES = {
    "nearest": "nearest to the last observed frame",
    "odd": "odd one out",
    "first": "first candidate",
    "latest": "latest candidate",
    "velocity": "constant velocity to the target's moment",
}
"""Name in tables of each reported baseline. Only `velocity` predicts, and it knows the moment."""


def baseline_results(
    items: Sequence[SelectionItem], store: Store, seed: int
) -> list[SelectionResult]:
    """Return the accuracies of the baselines on items. `seed` is that of the resampling."""
    scores = [score_baselines(item, store) for item in items]
    letters = [None] * len(items)
    choices = [
        Choices(title, BASELINE, None, [s[name] for s in scores], letters)
        for name, title in TITLES.items()
        if not np.isnan([s[name] for s in scores]).any()
    ]
    return build_selection_report(choices, items, store, seed).rows
