"""Write the report of evaluation.select or evaluation.similarity: report.txt, report.json and
selection.png."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path

from dynapix.conf.files import write_text
from dynapix.evaluation.metrics.results import SelectionReport
from dynapix.evaluation.reporting import tables
from dynapix.evaluation.reporting.figures import plot_accuracies
from dynapix.evaluation.reporting.reference import SUITE

log = logging.getLogger(__name__)


def write_report(report: SelectionReport, folder: Path, suite: str) -> None:
    """Write a report into `folder` and log its main tables. `suite` is the suite of the items."""
    results = report.rows
    parts = [tables.selection_table(results, suite)]
    parts += [tables.paired_table(report.controls)] if report.controls else []
    parts += [tables.pair_table(report.pairs)] if report.pairs else []
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += tables.detail_tables({r.key: (r.key, report) for r in results})
    write_text(folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    write_text(folder / "report.json", json.dumps(asdict(report), indent=1))
    by_family = {f"{r.name} ({r.variant})": r.families for r in results}
    plot_accuracies(by_family, folder / "selection.png", suite == SUITE)
