"""Checks of queries refuse invalid benchmarks and name the query."""

from __future__ import annotations

from dataclasses import replace

from data.records import FrameRef
from data.tracks.retrieval.checks import check_test, check_training
from tests.user_errors import raises_user_error


def test_built_benchmark_passes(micro_store) -> None:
    check_test(micro_store, micro_store.standard_test(), micro_store.database())
    check_training(micro_store, micro_store.retrieval("train"), 2)


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


def test_invalid_training_queries_are_refused(micro_store) -> None:
    queries = micro_store.retrieval("train")
    tested = micro_store.scene_ids("test")[0]
    first, second, *_ = queries
    poor = replace(second, hard_negatives=second.hard_negatives[:1])
    for code, contains, training_queries in (
        ("duplicate-record", first.query_id, [*queries, first, second]),
        ("split-leak", (first.query_id, tested), [replace(first, scene_id=tested)]),
        ("split-leak", tested, [replace(first, target=FrameRef(tested, 3))]),
        ("too-few-negatives", (second.query_id, "train.hard_negatives=1"), [first, poor]),
    ):
        with raises_user_error(code, contains):
            check_training(micro_store, training_queries, 2)
    check_training(micro_store, [first, poor], 1)
