"""A test that cannot measure anything is refused, and what is wrong with it named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from conf.errors import UserError
from data.records import FrameRef
from evaluation.checks import check_retrieval


def test_a_built_benchmark_passes(micro_store) -> None:
    check_retrieval(micro_store, micro_store.standard_test(), micro_store.database())


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
            check_retrieval(micro_store, asked, frames)
