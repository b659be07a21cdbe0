"""What a benchmark's queries must hold before a retriever is trained or measured on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence

from conf.errors import UserError
from data.records import FrameRef, RetrievalQuery
from data.store import Store


def check_training(store: Store, queries: Sequence[RetrievalQuery], negatives: int) -> None:
    """Hold the training queries against each other and against the test split; `negatives` is how
    many hard negatives each is to be trained with.

    Raises:
        UserError: an id stands there twice, a query's scene is measured on, or a query has too few
            hard negatives.
    """
    _check_ids(store, queries)
    tested = {*store.scene_ids("test"), *(q.scene_id for q in store.retrieval("test"))}
    if shared := [q for q in queries if _scenes(q) & tested]:
        query = shared[0]
        raise UserError(
            f"training query {query.query_id} is about scene {min(_scenes(query) & tested)}, which "
            f"is in the test split of {store.folder} too{_more(shared)}: a retriever would be "
            f"measured on what it was trained on; {_again(store)}"
        )
    if lacking := [q for q in queries if len(q.hard_negatives) < negatives]:
        query = min(lacking, key=lambda q: len(q.hard_negatives))
        fewest = len(query.hard_negatives)
        raise UserError(
            f"train.hard_negatives={negatives} is more than the {fewest} that query "
            f"{query.query_id} of {store.folder} has{_more(lacking)}: give "
            f"train.hard_negatives={fewest}, or {_again(store)}"
        )


def _scenes(query: RetrievalQuery) -> set[str]:
    """Those that a query, its target and its wrong frames show."""
    wrong = (frame.scene_id for frame in query.hard_negatives)
    return {query.scene_id, query.target.scene_id, *wrong}


def check_test(
    store: Store, queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> None:
    """Hold the test queries and their database against each other and against the training split.

    Raises:
        UserError: there is no query, an id or a frame stands there twice, a target is not in the
            database, or a query's scene is trained on.
    """
    if not queries:
        raise UserError(f"{store.folder} has no queries of the standard test to measure on")
    _check_ids(store, queries)
    if twice := _repeated((f.scene_id, f.frame) for f in database):
        scene_id, frame = twice[0]
        raise UserError(
            f"{store.folder}/database.parquet has frame {frame} of scene {scene_id} more than once "
            f"in database test{_more(twice)}: {_again(store)}"
        )
    there = set(database)
    if lacking := [q for q in queries if q.target not in there]:
        query = lacking[0]
        raise UserError(
            f"{store.folder}/database.parquet lacks frame {query.target.frame} of scene "
            f"{query.target.scene_id}, the target of query {query.query_id}, in database test"
            f"{_more(lacking)}: {_again(store)}"
        )
    trained = {*store.scene_ids("train"), *(q.scene_id for q in store.retrieval("train"))}
    if shared := [q for q in queries if {q.scene_id, q.target.scene_id} & trained]:
        query = shared[0]
        raise UserError(
            f"test query {query.query_id} is about scene {query.scene_id}, which is in the "
            f"training split of {store.folder} too{_more(shared)}: what was trained on proves "
            f"nothing; {_again(store)}"
        )


def _check_ids(store: Store, queries: Sequence[RetrievalQuery]) -> None:
    if twice := _repeated(q.query_id for q in queries):
        raise UserError(
            f"{store.folder}/retrieval.parquet has query {twice[0]} more than once"
            f"{_more(twice)}: {_again(store)}"
        )


def _repeated(names: Iterable[Hashable]) -> list:
    return [name for name, times in Counter(names).items() if times > 1]


def _more(found: Sequence) -> str:
    return f" ({len(found) - 1} more such)" if len(found) > 1 else ""


def _again(store: Store) -> str:
    return f"delete {store.folder} and build it again with python -m data.build"
