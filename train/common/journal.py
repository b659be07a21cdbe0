"""A run's journal: what was logged while it trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from conf.multirun.table import AT_START_SUFFIX
from conf.runs import read_json_lines

JOURNAL = "metrics.jsonl"
ANSWERS = "samples.jsonl"
"""A student's answers at each evaluation of its run, one JSON line each."""
CURVES = "curves.png"
BEST_STEP = "best_step"
"""Name of the kept checkpoint's step among a run's metrics."""


def read_journal(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's metrics.jsonl without a line that a kill cut off."""
    return read_lines(folder / JOURNAL)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the JSON lines of a file that have a step."""
    records = read_json_lines(path) if path.exists() else ()
    return [record for record in records if "step" in record]


def run_metrics(folder: Path, best_step: int | None = None) -> dict[str, float]:
    """Return a run's metrics: `<name>_at_start` of the first evaluation and `<name>` of the kept
    weights, which are those of the last step or of `best_step`."""
    records = [r for r in read_journal(folder) if any(k.startswith("eval_") for k in r)]
    metrics: dict[str, float] = {}
    if best_step is not None:
        records = [r for r in records if r["step"] <= best_step]
        metrics[BEST_STEP] = float(best_step)
    for record in records:
        for key, value in record.items():
            if key.startswith("eval_"):
                name = key.removeprefix("eval_")
                metrics.setdefault(f"{name}{AT_START_SUFFIX}", value)
                metrics[name] = value
    return metrics
