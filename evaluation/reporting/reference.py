"""The results that the paper prints, read from `reference.yaml`."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml

SUITE = "dynapix"
"""The suite whose items the paper's selection tables cover."""
COT_STUDENT = "Physics-grounded CoT"
"""The name of the paper's CoT student in `reference.yaml`."""
NOT_MODELS = ("Chance", "Human, majority vote")
"""Names of rows that are not compared with models for the best value of a column."""


@cache
def reference(group: str) -> Any:
    """Return a group of `reference.yaml`: a list of rows, or a number.

    A row has a `name` and values by column heading.
    """
    text = (files("evaluation.reporting") / "reference.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[group]


def cot_student() -> dict[str, Any]:
    """Return the row of the paper's CoT student."""
    return next(row for row in reference("selection_distilled") if row["name"] == COT_STUDENT)


def reference_rows(group: str, columns: list[str]) -> list[list[str]]:
    """Return the rows of a group as table cells under `columns`.

    A cell is "-" if the paper prints no value for it, and empty if no row of the group has its
    column. A row with `horizons`, its accuracies in the time family by seconds to the target, is
    followed by one row for each of them.
    """
    rows, printed = [], {column for row in reference(group) for column in row}
    for row in reference(group):
        cells = [_format(row.get(c), c) if c in printed else "" for c in columns]
        rows.append([row["name"], *cells])
        for horizon, percent in row.get("horizons", {}).items():
            cells = [f"{percent:.1f}" if column == "Time" else "" for column in columns]
            rows.append([f"  time, {horizon}", *cells])
    return rows


def _format(value: float | None, column: str) -> str:
    if value is None:
        return "-"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.3f}" if column == "MRR" else f"{value:.1f}"
