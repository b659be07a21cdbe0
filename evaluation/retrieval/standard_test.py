"""What the commands that rank a benchmark's standard test share: how they open, rank and report."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from conf.runs import write_text
from conf.schema import RetrieverConfig
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from data.tracks.retrieval.checks import check_test
from evaluation.embedders.cache import EmbeddingCache
from evaluation.reporting import figures, tables
from evaluation.reporting.results import RetrievalResult
from evaluation.reporting.table import Table
from evaluation.retrieval.exact_search import Ranks, exact_ranks

log = logging.getLogger(__name__)


def load_standard_test(store: Store) -> tuple[list[RetrievalQuery], list[FrameRef]]:
    """The queries and the database. Errors are those of `check_test`."""
    queries, database = store.standard_test(), store.database("test")
    check_test(store, queries, database)
    return queries, database


def in_parts(shown: EmbeddingCache, names: Sequence[str]) -> Iterator[np.ndarray]:
    """The embeddings of `names`, in no order, a file at a time, with how many are through."""
    with tqdm(total=len(names), desc="ranking", unit="frame", leave=False) as bar:
        for numbers, rows in shown.parts(names):
            yield rows
            bar.update(len(numbers))


def rank_targets(
    preset: RetrieverConfig,
    asked: np.ndarray,
    targets: np.ndarray,
    database: Iterable[np.ndarray],
) -> Ranks:
    """Exact ranks by a retriever's own scores. Arguments are those of `exact_ranks`."""
    if preset.late is not None:
        from evaluation.retrieval.late_interaction import late_ranks

        return late_ranks(asked, targets, database, preset.late.width)
    return exact_ranks(asked, targets, database, preset.widths)


def write_ranks(
    folder: Path, found: Mapping[str, Ranks], queries: Sequence[RetrievalQuery]
) -> None:
    """Write ranks.jsonl: for each retriever and query how many frames stand before its target, and
    how many more score just as it does, at each width; null where it was not found."""
    lines = []
    for name, ranks in found.items():
        for k, query in enumerate(queries):
            there = ranks.found[:, k]
            counts = {
                what: [int(n) if known else None for n, known in zip(of[:, k], there, strict=True)]
                for what, of in (("before", ranks.greater), ("tied", ranks.tied))
            }
            told = {"by": name, "query_id": query.query_id, "widths": ranks.widths, **counts}
            lines.append(json.dumps(told))
    write_text(folder / "ranks.jsonl", "".join(f"{line}\n" for line in lines))


def write_report(
    folder: Path,
    rows: Sequence[RetrievalResult],
    curves: Sequence[dict[str, Any]],
    told: Sequence[Table] = (),
    reference_group: str = "retrieval_distilled",
    **also: Any,
) -> None:
    """Write report.txt, report.json and the figures of some rows; `told` are more tables and `also`
    more entries."""
    table = f"{tables.retrieval_table(rows, reference_group)}\n\n{tables.cost_table(rows)}"
    log.info("%s", table)
    page = "\n\n".join(map(str, [table, *told, *tables.builder_tables(rows)]))
    write_text(folder / "report.txt", page + "\n")
    report = {"rows": [r.to_dict() for r in rows], "curves": curves, **also}
    write_text(folder / "report.json", json.dumps(report, indent=1))
    figures.retrieval_figure(rows, folder / "retrieval.png")
    figures.builders_figure(rows, curves, folder / "builders.png")
