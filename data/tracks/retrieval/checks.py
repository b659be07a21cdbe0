"""Checks of a benchmark's queries before a retriever is trained or evaluated on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from conf.errors import UserError
from data.records import FrameRef, RetrievalQuery
from data.store import Store


def check_training(store: Store, queries: Sequence[RetrievalQuery], negatives: int) -> None:
    """Check training queries against each other and against the test split.

    Args:
        negatives: Number of hard negatives that training uses for each query.

    Raises:
        UserError: a query id occurs twice, a query refers to a test scene, or a query has too few
            hard negatives.
    """
    _refuse_repeated(store, "retrieval", [f"query {q.query_id}" for q in queries])
    _refuse_leaks(store, queries, "test")
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
    """Check test queries and their database against each other and against the training split.

    Raises:
        UserError: the benchmark has no test queries, a query id or a frame occurs twice, a target
            is missing from the database, or a query refers to a training scene.
    """
    if not queries:
        raise UserError(
            f"{store.folder} has no queries of the standard test", code="missing-queries"
        )
    _refuse_repeated(store, "retrieval", [f"query {q.query_id}" for q in queries])
    _refuse_repeated(
        store, "database", [f"frame {f.frame} of scene {f.scene_id}" for f in database]
    )
    frames = set(database)
    lacking = [
        f"database test lacks frame {q.target.frame} of scene {q.target.scene_id}, the target of "
        f"query {q.query_id}"
        for q in queries
        if q.target not in frames
    ]
    _refuse(store, "missing-target", lacking)
    _refuse_leaks(store, queries, "train")


def _refuse_leaks(store: Store, queries: Sequence[RetrievalQuery], other: str) -> None:
    """Refuse queries of one split that refer to a scene of the other one."""
    scenes = {*store.scene_ids(other), *(q.scene_id for q in store.retrieval(other))}
    leaked = [
        f"query {q.query_id} of the {q.split} split refers to scene {f.scene_id} of the {other} "
        "split, which would invalidate the evaluation"
        for q in queries
        for f in (FrameRef(q.scene_id, q.prefix_stop), q.target, *q.hard_negatives)
        if f.scene_id in scenes
    ]
    _refuse(store, "split-leak", leaked)


def _refuse_repeated(store: Store, table: str, names: Sequence[str]) -> None:
    counts = Counter(names)
    repeated = [f"{table}.parquet has {name} {n} times" for name, n in counts.items() if n > 1]
    _refuse(store, "duplicate-record", repeated)


def _refuse(store: Store, code: str, problems: Sequence[str], advice: str = "") -> None:
    if problems:
        more = f" ({len(problems) - 1} more)" if len(problems) > 1 else ""
        raise UserError(
            f"{store.folder}: {problems[0]}{more}; {advice}delete this folder and build it again "
            "with python -m data.build",
            code=code,
        )
