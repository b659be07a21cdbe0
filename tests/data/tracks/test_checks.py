"""Queries that prove nothing are refused, and what is wrong with them named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from conf.errors import UserError
from data.records import FrameRef
from data.tracks.retrieval.checks import check_test, check_training


def test_a_built_benchmark_passes(micro_store) -> None:
    check_test(micro_store, micro_store.standard_test(), micro_store.database())
    check_training(micro_store, micro_store.retrieval("train"), 2)


def test_bad_tests_are_named(micro_store) -> None:
    queries, database = micro_store.standard_test(), micro_store.database()
    target = queries[3].target
    (trained, *_) = micro_store.scene_ids("train")
    seen = replace(queries[2], scene_id=trained)
    for asked, frames, said in (
        ([], database, "has no queries of the standard test"),
        ([*queries, queries[1]], database, f"has query {queries[1].query_id} more than once"),
        (
            queries,
            [*database, database[5], database[5]],
            f"has frame {database[5].frame} of scene {database[5].scene_id} more than once",
        ),
        (
            queries,
            [f for f in database if f != target],
            f"lacks frame {target.frame} of scene {target.scene_id}, the target of query ",
        ),
        (
            [*queries, replace(seen, query_id="new")],
            database,
            f"query new is about scene {trained}",
        ),
        (
            [replace(queries[0], target=FrameRef(trained, 5))],
            [*database, FrameRef(trained, 5)],
            "is in the training split",
        ),
    ):
        with pytest.raises(UserError, match=said):
            check_test(micro_store, asked, frames)


def test_bad_training_queries_are_named(micro_store) -> None:
    queries = micro_store.retrieval("train")
    tested = micro_store.scene_ids("test")[0]
    first, second, *_ = queries
    poor = replace(second, hard_negatives=second.hard_negatives[:1])
    for asked, said in (
        ([*queries, first, second], rf"has query {first.query_id} more than once \(1 more such\)"),
        (
            [replace(first, scene_id=tested)],
            f"training query {first.query_id} is about scene {tested}, which is in the test split",
        ),
        ([replace(first, target=FrameRef(tested, 3))], "in the test split"),
        (
            [first, poor],
            rf"train\.hard_negatives=2 is more than the 1 that query {second.query_id} .* "
            r"give train\.hard_negatives=1",
        ),
    ):
        with pytest.raises(UserError, match=said):
            check_training(micro_store, asked, 2)
    check_training(micro_store, [first, poor], 1)
