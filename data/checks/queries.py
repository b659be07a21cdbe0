"""Checks of a benchmark's queries before a retriever is trained or evaluated on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from dynapix.conf.errors import UserError
from dynapix.data.records import FrameRef, RetrievalQuery, original_scene_id
from dynapix.data.store import Store

QUOTAS = {"future": "builders", "counterfactual": "counterfactual"}
"""The setting below benchmark.retrieval with the quotas of each pool."""


def read_queries(store: Store, split: str, pool: str) -> list[RetrievalQuery]:
    """Return the queries of a split in a pool. Raises UserError if there are none."""
    if queries := store.retrieval(split, pool):
        return queries
    raise UserError(
        f"{store.folder} has no {pool} queries in the {split} split: choose a benchmark whose "
        f"benchmark.retrieval.{QUOTAS[pool]} has a quota of {split} queries, such as "
        "benchmark=tiny",
        code="missing-queries",
    )


def check_training(store: Store, queries: Sequence[RetrievalQuery], negatives: int) -> None:
    """Raises UserError if a query occurs twice, refers to a test scene, or has fewer than
    `negatives` hard negatives."""
    _refuse(store, "duplicate-record", _find_repeated("retrieval", queries))
    _refuse(store, "split-leak", _find_leaks(store, queries, "test"))
    fewest = min((len(q.hard_negatives) for q in queries), default=negatives)
    lacking = [
        f"train.hard_negatives={negatives}, but query {q.query_id} has {len(q.hard_negatives)}"
        for q in queries
        if len(q.hard_negatives) < negatives
    ]
    _refuse(store, "too-few-negatives", lacking, f"set train.hard_negatives={fewest}, or ")


def check_test(
    store: Store, queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> None:
    """Raises UserError if a query or frame occurs twice, a query refers to a training scene, or
    the database lacks a target."""
    repeated = _find_repeated("retrieval", queries) + _find_repeated("database", database)
    _refuse(store, "duplicate-record", repeated)
    frames = set(database)
    lacking = [
        f"the database lacks frame {q.target.name}, the target of query {q.query_id}"
        for q in queries
        if q.target not in frames
    ]
    _refuse(store, "missing-target", lacking)
    _refuse(store, "split-leak", _find_leaks(store, queries, "train"))


def _find_leaks(store: Store, queries: Sequence[RetrievalQuery], other: str) -> list[str]:
    """Describe every reference of a query to a scene of the split `other`."""
    scenes = {*store.scene_ids(other), *(q.scene_id for q in store.retrieval(other))}
    return [
        f"query {q.query_id} of the {q.split} split refers to scene {f.scene_id} of the {other} "
        "split, which would invalidate the evaluation"
        for q in queries
        for f in (FrameRef(q.scene_id, q.prefix_stop), q.target, *q.hard_negatives)
        if original_scene_id(f.scene_id) in scenes
    ]


def _find_repeated(table: str, records: Sequence[RetrievalQuery | FrameRef]) -> list[str]:
    counts = Counter(record.name for record in records)
    return [f"{table}.parquet contains {name} {n} times" for name, n in counts.items() if n > 1]


def _refuse(store: Store, code: str, problems: Sequence[str], advice: str = "") -> None:
    if problems:
        more = f" ({len(problems) - 1} more problems)" if len(problems) > 1 else ""
        raise UserError(
            f"{store.folder}: {problems[0]}{more}; {advice}delete this folder and build it again "
            "with python -m data.build benchmark=NAME",
            code=code,
        )
