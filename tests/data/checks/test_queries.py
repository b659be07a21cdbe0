"""`check_test` refuses missing and repeated test queries, queries without their target, and queries
of training scenes, and names one of them."""

from __future__ import annotations

from dataclasses import replace

from data.checks.queries import check_test
from data.records import FrameRef
from tests.user_errors import raises_user_error


def test_invalid_test_queries_are_refused(micro_store) -> None:
    queries, database = micro_store.standard_test(), micro_store.database()
    target = queries[3].target
    (trained, *_) = micro_store.scene_ids("train")
    leaked = replace(queries[2], query_id="new", scene_id=trained)
    moved = replace(queries[0], target=FrameRef(trained, 5))
    for code, contains, test_queries, frames in (
        ("missing-queries", (), [], database),
        ("duplicate-record", queries[1].query_id, [*queries, queries[1]], database),
        ("duplicate-record", database[5].scene_id, queries, [*database, database[5], database[5]]),
        ("missing-target", target.scene_id, queries, [f for f in database if f != target]),
        ("split-leak", ("new", trained), [*queries, leaked], database),
        ("split-leak", trained, [moved], [*database, FrameRef(trained, 5)]),
    ):
        with raises_user_error(code, contains):
            check_test(micro_store, test_queries, frames)
