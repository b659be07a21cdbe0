"""A sweep's table: a row a job, from the folder that the sweep left."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from conf.errors import UserError
from conf.runs import write_text

JOB_FILE = "job.json"
AT_START_SUFFIX = "_at_start"
"""End of the name of a metric measured before a run's first step."""
LESS_IS_BETTER = r"loss|_rank$|set_aside|too_short|reject"


@dataclass
class Job:
    number: int
    overrides: list[str]
    status: str
    """done or failed."""
    seconds: float | None
    """Wall time; None for a job that an earlier, killed sweep finished."""
    metrics: dict[str, float]


def read_jobs(folder: Path) -> list[Job]:
    """The jobs of a sweep that have ended, by number."""
    jobs = []
    for path in folder.glob(f"[0-9]*/{JOB_FILE}"):
        metrics = path.with_name("metrics.json")
        told = json.loads(path.read_text())
        found = final_metrics(json.loads(metrics.read_text())) if metrics.exists() else {}
        jobs.append(
            Job(int(path.parent.name), **told, metrics=found if told["status"] == "done" else {})
        )
    return sorted(jobs, key=lambda job: job.number)


def final_metrics(metrics: dict[str, float]) -> dict[str, float]:
    """What a run came to: its metrics but those of its start, which jobs mostly share."""
    return {name: value for name, value in metrics.items() if not name.endswith(AT_START_SUFFIX)}


def write_sweep_table(folder: Path) -> str:
    """A sweep's table as text, which is also written as sweep.txt, beside sweep.csv and sweep.png.

    Raises UserError where no job has ended.
    """
    jobs = read_jobs(folder)
    if not jobs:
        raise UserError(f"{folder} holds no sweep with a job that has ended")
    metrics = sorted({name for job in jobs for name in job.metrics})
    settings = varying_overrides([job.overrides for job in jobs])
    rows = [
        {"job": job.number, **told, **job.metrics, "status": job.status, "seconds": job.seconds}
        for job, told in zip(jobs, settings, strict=True)
    ]
    columns = ["job", *dict.fromkeys(key for told in settings for key in told), *metrics]
    columns += ["status", "seconds"]
    text = _text(rows, columns, metrics)
    write_text(folder / "sweep.txt", text + "\n")
    with io.StringIO(newline="") as out:
        writer = csv.DictWriter(out, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
        write_text(folder / "sweep.csv", out.getvalue())
    if metrics:
        _plot(folder / "sweep.png", rows, settings, metrics)
    return text


def varying_overrides(jobs: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each job the overrides, key to value, that not all jobs share."""
    told = [dict(o.lstrip("+").split("=", 1) for o in job if "=" in o) for job in jobs]
    keys = dict.fromkeys(key for job in told for key in job)
    differ = [key for key in keys if len({job.get(key) for job in told}) > 1]
    return [{key: job[key] for key in differ if key in job} for job in told]


def is_lower_better(name: str) -> bool:
    """Whether a metric is a loss, a rank or a count of what was refused."""
    return re.search(LESS_IS_BETTER, name) is not None


def best_value(name: str, values: Sequence[float]) -> float | None:
    """The best of a metric's values that are numbers."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return None
    return (min if is_lower_better(name) else max)(finite)


def _text(rows: list[dict[str, Any]], columns: list[str], metrics: list[str]) -> str:
    bests = {name: best_value(name, [row[name] for row in rows if name in row]) for name in metrics}
    cells = [columns]
    for row in rows:
        told = {key: _shown(row.get(key)) for key in columns}
        for name, value in bests.items():
            if value is not None and row.get(name) == value:
                told[name] += "*"
        cells.append([told[key] for key in columns])
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in cells)


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _plot(
    path: Path, rows: list[dict[str, Any]], settings: list[dict[str, str]], metrics: list[str]
) -> None:
    # Imported here because a command that sweeps nothing need not wait for it.
    from matplotlib.figure import Figure

    labels = ["\n".join(told.values()) or str(i) for i, told in enumerate(settings)]
    columns = min(2, len(metrics))
    lines = math.ceil(len(metrics) / columns)
    size = (columns * max(4.0, 1.2 + 0.8 * len(rows)), 0.8 + 2.2 * lines)
    figure = Figure(figsize=size, layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes, name in zip(panels, metrics, strict=False):
        axes.plot(range(len(rows)), [row.get(name, math.nan) for row in rows], "o")
        axes.set_title(name.replace("_", " "), fontsize="medium", loc="left")
        axes.set_xticks(range(len(rows)), labels)
        axes.set_xlim(-0.5, len(rows) - 0.5)
        axes.grid(axis="y", alpha=0.3)
    for axes in panels[len(metrics) :]:
        axes.set_axis_off()
    figure.supxlabel(" / ".join(dict.fromkeys(key for told in settings for key in told)))
    figure.savefig(path, dpi=120)
