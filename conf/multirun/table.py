"""The table of a sweep: one row per job, read from the jobs' folders."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dynapix.conf.files import read_json, write_text

JOB_FILE = "job.json"
AT_START_SUFFIX = "_at_start"
"""Suffix of the metrics that are measured before the first training step. Tables of sweeps leave
them out, because they have the same value in most jobs."""
LOWER_IS_BETTER = r"loss|_error(/|$)|_rank$|set_aside|too_short|reject"
"""Pattern in the names of the metrics of which lower values are better."""
MAIN_METRICS = (
    "reasoning_generated_accuracy", "answer_generated_accuracy", "reward", "recall@10", "mrr",
)  # fmt: skip
"""Metrics that precede the others, which are in alphabetical order."""


def read_jobs(folder: Path) -> list[dict[str, Any]]:
    """Return the jobs of a sweep that have ended, by number."""
    paths = [p for p in folder.glob(f"*/{JOB_FILE}") if p.parent.name.isdecimal()]
    jobs = [read_job(path.parent) for path in paths]
    return sorted(jobs, key=lambda job: job["job"])


def read_job(folder: Path) -> dict[str, Any]:
    """Return the record of an ended job: its number (`job`), `overrides`, `status` (done or failed)
    and `metrics`, in the order of a table and without those that are measured before training."""
    job = read_json(folder / JOB_FILE)
    path = folder / "metrics.json"
    metrics = read_json(path) if job["status"] == "done" and path.exists() else {}
    names = sorted((n for n in metrics if not n.endswith(AT_START_SUFFIX)), key=metric_position)
    final = {name: metrics[name] for name in names}
    return {"job": int(folder.name), "metrics": final, **job}


def write_sweep_table(folder: Path) -> str:
    """Write the table of a sweep to sweep.csv and to sweep.txt, where a * marks the best value of
    each metric.

    Returns:
        The text of sweep.txt.
    """
    # Imported here because most commands run no sweep.
    import pandas as pd

    jobs = read_jobs(folder)
    metrics = sorted({name for job in jobs for name in job["metrics"]}, key=metric_position)
    settings = varying_overrides([job["overrides"] for job in jobs])
    rows = [
        {"job": job["job"]}
        | varying
        | {name: job["metrics"].get(name) for name in metrics}
        | {"status": job["status"]}
        for job, varying in zip(jobs, settings, strict=True)
    ]
    table = pd.DataFrame(rows)
    write_text(folder / "sweep.csv", table.to_csv(index=False))
    text = table.map(lambda value: f"{value:.4g}" if isinstance(value, float) else str(value))
    for name in metrics:
        best = table[name].min() if is_lower_better(name) else table[name].max()
        text[name] += (table[name] == best).map({True: "*", False: ""})
    text = text.mask(table.isna(), "-")
    lines = text.to_string(index=False, justify="left").splitlines()
    page = "\n".join(line.rstrip() for line in lines)
    write_text(folder / "sweep.txt", page + "\n")
    return page


def varying_overrides(jobs: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each job, a dict of its overrides whose values differ between the jobs."""
    by_key = [dict(o.lstrip("+").split("=", 1) for o in job if "=" in o) for job in jobs]
    keys = dict.fromkeys(key for job in by_key for key in job)
    differ = [key for key in keys if len({job.get(key) for job in by_key}) > 1]
    return [{key: job[key] for key in differ if key in job} for job in by_key]


def metric_position(metric: str) -> tuple[int, str]:
    """Return a sort key of the metrics of a table: the main metrics first."""
    main = MAIN_METRICS.index(metric) if metric in MAIN_METRICS else len(MAIN_METRICS)
    return main, metric


def is_lower_better(metric: str) -> bool:
    """Return whether lower values of a metric are better: losses, errors, ranks, and the numbers of
    rejected responses, of items that were set aside, and of items whose prefix is too short."""
    return re.search(LOWER_IS_BETTER, metric) is not None
