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
        UserError: a query id occurs twice, a query's scene is a test scene, or a query has too few
            hard negatives.
    """
    _check_ids(store, queries)
    tested = {*store.scene_ids("test"), *(q.scene_id for q in store.retrieval("test"))}
    if leaked := [q for q in queries if _scenes(q) & tested]:
        query = leaked[0]
        raise UserError(
            f"training query {query.query_id} refers to scene {min(_scenes(query) & tested)} of "
            f"the test split{_others(leaked)}, which would invalidate the evaluation; "
            f"{_rebuild(store)}",
            code="split-leak",
        )
    if lacking := [q for q in queries if len(q.hard_negatives) < negatives]:
        query = min(lacking, key=lambda q: len(q.hard_negatives))
        fewest = len(query.hard_negatives)
        raise UserError(
            f"train.hard_negatives={negatives}, but query {query.query_id} of {store.folder} has "
            f"{fewest}{_others(lacking)}: set train.hard_negatives={fewest}, or {_rebuild(store)}",
            code="too-few-negatives",
        )


def check_test(
    store: Store, queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> None:
    """Check test queries and their database against each other and against the training split.

    Raises:
        UserError: the benchmark has no test queries, a query id or a frame occurs twice, a target
            is missing from the database, or a query's scene is a training scene.
    """
    if not queries:
        raise UserError(
            f"{store.folder} has no queries of the standard test", code="missing-queries"
        )
    _check_ids(store, queries)
    _check_unique(store, [f"frame {f.frame} of scene {f.scene_id}" for f in database], "database")
    frames = set(database)
    if lacking := [q for q in queries if q.target not in frames]:
        query = lacking[0]
        raise UserError(
            f"{store.folder}/database.parquet lacks frame {query.target.frame} of scene "
            f"{query.target.scene_id}, the target of query {query.query_id}, in database test"
            f"{_others(lacking)}: {_rebuild(store)}",
            code="missing-target",
        )
    trained = {*store.scene_ids("train"), *(q.scene_id for q in store.retrieval("train"))}
    if leaked := [q for q in queries if {q.scene_id, q.target.scene_id} & trained]:
        query = leaked[0]
        raise UserError(
            f"test query {query.query_id} refers to scene {query.scene_id} and target scene "
            f"{query.target.scene_id}, one of which is in the training split of {store.folder}"
            f"{_others(leaked)}; {_rebuild(store)}",
            code="split-leak",
        )


def _scenes(query: RetrievalQuery) -> set[str]:
    """The scenes of a query's prefix, target and hard negatives."""
    negatives = (frame.scene_id for frame in query.hard_negatives)
    return {query.scene_id, query.target.scene_id, *negatives}


def _check_ids(store: Store, queries: Sequence[RetrievalQuery]) -> None:
    _check_unique(store, [f"query {q.query_id}" for q in queries], "retrieval")


def _check_unique(store: Store, names: Sequence[str], table: str) -> None:
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise UserError(
            f"{store.folder}/{table}.parquet has {repeated[0]} more than once{_others(repeated)}: "
            f"{_rebuild(store)}",
            code="duplicate-record",
        )


def _others(records: Sequence) -> str:
    return f" ({len(records) - 1} more)" if len(records) > 1 else ""


def _rebuild(store: Store) -> str:
    return f"delete {store.folder} and build it again with python -m data.build"
