"""A run's journal: the losses and measures that its trainer logged, one JSON line per log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dynapix.conf.files import read_json_lines
from dynapix.conf.multirun.table import AT_START_SUFFIX

JOURNAL = "metrics.jsonl"
ANSWERS = "samples.jsonl"
"""The answers that a student generated at each evaluation, one JSON line per answer."""
CURVES = "curves.png"


def read_journal(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of the metrics.jsonl in a run's folder, as `read_lines` does."""
    return read_lines(folder / JOURNAL)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the JSON lines of a file that have a step. Lines that a kill cut off are skipped; a
    missing file has no lines."""
    records = read_json_lines(path) if path.exists() else ()
    return [record for record in records if "step" in record]


def run_metrics(folder: Path) -> dict[str, float]:
    """Return a run's metrics: `<name>_at_start` from the first evaluation, and `<name>` from the
    last one."""
    metrics: dict[str, float] = {}
    for record in read_journal(folder):
        for key, value in record.items():
            if key.startswith("eval_"):
                name = key.removeprefix("eval_")
                metrics.setdefault(f"{name}{AT_START_SUFFIX}", value)
                metrics[name] = value
    return metrics
