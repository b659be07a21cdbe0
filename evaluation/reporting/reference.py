"""The results of the paper, read from `reference.yaml`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

from dynapix.data.records import FAMILIES
from dynapix.evaluation.reporting.table import DETAIL, FORMATS, Row, Table

SUITE = "dynapix"
"""The suite (set of items) that the paper's selection tables measure."""
COT_STUDENT = "Physics-grounded CoT"
"""The name of the paper's CoT student in `reference.yaml`."""


@cache
def reference(group: str) -> Any:
    """Return the value of a top-level key of `reference.yaml`, such as a list of rows.

    A row is a dictionary of its `name` and of values by column heading.
    """
    text = (files("dynapix.evaluation.reporting") / "reference.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)[group]


def cot_student() -> dict[str, float]:
    """Return the accuracies (%) of the paper's CoT student by family and by time horizon."""
    row = next(row for row in reference("selection_distilled") if row["name"] == COT_STUDENT)
    return {family: row[family.capitalize()] for family in FAMILIES} | row["horizons"]


def reference_rows(group: str) -> list[Row]:
    """Return the rows of a group as rows of a `Table`. Values that the paper lacks are None.

    If a row has `horizons` (accuracies in the time family by the time to the target), a row for
    each horizon follows.
    """
    rows, columns = [], {column for row in reference(group) for column in row} - {"horizons"}
    for row in reference(group):
        values = {column: _to_share(column, row.get(column)) for column in columns}
        rows.append({**values, "ranked": row.get("ranked", True)})
        for horizon, percent in row.get("horizons", {}).items():
            name = f"{DETAIL}time, {horizon}"
            rows.append({"name": name, "Time": percent / 100, "ranked": False})
    return rows


def table_with_paper(
    key: str,
    name: str,
    columns: Sequence[str],
    groups: Mapping[str, Sequence[Row]],
    notes: tuple[str, ...],
) -> Table:
    """Return a table with the caption and the paper's rows of `tables[key]` in `reference.yaml`."""
    entry = reference("tables")[key]
    paper = {
        label: [row for paper_group in paper_groups for row in reference_rows(paper_group)]
        for label, paper_groups in entry["paper"].items()
    }
    return Table(name, entry["caption"], columns, groups, notes, paper)


def _to_share(column: str, value: Any) -> Any:
    """Convert a percentage to a fraction; return other values unchanged."""
    return value / 100 if isinstance(value, float) and column not in FORMATS else value
