"""The test of retrieval: its queries and database, and the report.

The queries of the standard test are the future-state queries of the test split; the counterfactual
queries of this split have a test of their own. The database holds frames of test scenes, with every
target and every factual twin among them.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dynapix.conf.files import write_text
from dynapix.data.checks.baselines import count_frames_of_scene
from dynapix.data.checks.queries import check_test, read_queries
from dynapix.data.records import FrameRef, RetrievalQuery
from dynapix.data.store import Store
from dynapix.evaluation.metrics.results import SCENE_ALONE, RetrievalResult, retrieval_results
from dynapix.evaluation.reporting import figures, tables
from dynapix.evaluation.reporting.table import Table
from dynapix.evaluation.retrieval.exact_search import Ranks

log = logging.getLogger(__name__)


def load_test(store: Store, pool: str = "future") -> tuple[list[RetrievalQuery], list[FrameRef]]:
    """Return the queries and the database, by default of the standard test. Raise UserError if
    there are no queries, and as `check_test` does."""
    queries, database = read_queries(store, "test", pool), store.ranked_frames("test", pool)
    check_test(store, queries, database)
    return queries, database


def score_scene_alone(
    benchmark: str, queries: Sequence[RetrievalQuery], database: Sequence[FrameRef], seed: int
) -> list[RetrievalResult]:
    """Return the results of a ranker that only recognises the scene: its frames, and those of its
    counterfactual, tie above all others."""
    tied = count_frames_of_scene(queries, database)[None] - 1
    found = np.ones(len(queries), bool)
    twin_above = np.full(tied.shape, 0.5) if queries[0].factual_twin else None
    ranks = Ranks((None,), np.zeros_like(tied), tied, found, len(database), twin_above=twin_above)
    return retrieval_results(benchmark, SCENE_ALONE, ranks, queries, seed)


def write_report(
    folder: Path,
    rows: Sequence[RetrievalResult],
    extra_tables: Sequence[Table] = (),
    command: str = "retrieve",
    **entries: Any,
) -> None:
    """Write report.txt, report.json and retrieval.png.

    Args:
        extra_tables: Tables that follow the main table in report.txt.
        command: retrieve or two_stage; determines which rows of the paper are shown.
        entries: Entries of report.json besides `rows`.
    """
    table = str(tables.retrieval_table(rows, command))
    log.info("%s", table)
    page = "\n\n".join(map(str, [table, *extra_tables, *tables.builder_tables(rows)]))
    write_text(folder / "report.txt", page + "\n")
    report = {"rows": rows, **entries}
    write_text(folder / "report.json", json.dumps(report, indent=1, default=asdict))
    figures.plot_recalls([(row.name, row) for row in rows], folder / "retrieval.png")
