"""The paper's printed results, read from `reference.yaml`."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml

SUITE = "dynapix"
"""The suite of the items in the paper's selection tables by family."""
COT_STUDENT = "Physics-grounded CoT"
NOT_MODELS = ("Chance", "Human, majority vote")


@cache
def reference(group: str) -> Any:
    """A group of `reference.yaml`: rows with a `name` and values by column heading, or a number."""
    text = (files("evaluation.reporting") / "reference.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[group]


def cot_student() -> dict[str, Any]:
    """The row of the paper's reasoning student."""
    return next(row for row in reference("selection_distilled") if row["name"] == COT_STUDENT)


def reference_rows(group: str, columns: list[str]) -> list[list[str]]:
    """The rows of a group as table cells under `columns`; "-" where the paper prints no value,
    and empty in columns that no row of the group has.

    Rows with `horizons` are followed by a line for each horizon of the time family.
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
