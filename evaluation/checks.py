"""What a benchmark's test must hold before a model is measured on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence

from conf.errors import UserError
from data.records import FrameRef, RetrievalQuery
from data.store import Store


def check_retrieval(
    store: Store, queries: Sequence[RetrievalQuery], database: Sequence[FrameRef]
) -> None:
    """Hold the test queries and their database against each other and against the training split.

    Raises:
        UserError: there is no query, an id or a frame stands there twice, a target is not in the
            database, or a query's scene is trained on.
    """
    again = f"build {store.folder} again with python -m data.build"
    if not queries:
        raise UserError(f"{store.folder} has no queries of the standard test to measure on")
    if twice := _repeated(q.query_id for q in queries):
        raise UserError(
            f"{store.folder}/retrieval.parquet has query {twice[0]} more than once"
            f"{_more(twice)}: {again}"
        )
    if twice := _repeated((f.scene_id, f.frame) for f in database):
        scene_id, frame = twice[0]
        raise UserError(
            f"{store.folder}/database.parquet has frame {frame} of scene {scene_id} more than once "
            f"in database test{_more(twice)}: {again}"
        )
    there = set(database)
    if lacking := [q for q in queries if q.target not in there]:
        query = lacking[0]
        raise UserError(
            f"{store.folder}/database.parquet lacks frame {query.target.frame} of scene "
            f"{query.target.scene_id}, the target of query {query.query_id}, in database test"
            f"{_more(lacking)}: {again}"
        )
    trained = {*store.scene_ids("train"), *(q.scene_id for q in store.retrieval("train"))}
    shared = [q for q in queries if {q.scene_id, q.target.scene_id} & trained]
    if shared:
        query = shared[0]
        raise UserError(
            f"test query {query.query_id} is about scene {query.scene_id}, which is in the "
            f"training split of {store.folder} too{_more(shared)}: what was trained on proves "
            f"nothing; {again}"
        )


def _repeated(names: Iterable[Hashable]) -> list:
    return [name for name, times in Counter(names).items() if times > 1]


def _more(found: Sequence) -> str:
    return f" ({len(found) - 1} more such)" if len(found) > 1 else ""
