"""`check_test` refuses repeated test queries, queries without their target, and queries of training
scenes, and names one of them; `read_queries` refuses a pool without queries."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.checks.queries import check_test, check_training, read_queries
from dynapix.data.records import SPLITS, FrameRef
from dynapix.data.store import Store
from tests.user_errors import raises_user_error


def test_invalid_test_queries_are_refused(micro_store) -> None:
    queries, database = micro_store.standard_test(), micro_store.database()
    target = queries[3].target
    (trained, *_) = micro_store.scene_ids("train")
    leaked = replace(queries[2], query_id="new", scene_id=trained)
    moved = replace(queries[0], target=FrameRef(trained, 5))
    for code, contains, test_queries, frames in (
        ("duplicate-record", queries[1].query_id, [*queries, queries[1]], database),
        ("duplicate-record", database[5].scene_id, queries, [*database, database[5], database[5]]),
        ("missing-target", target.scene_id, queries, [f for f in database if f != target]),
        ("split-leak", ("new", trained), [*queries, leaked], database),
        ("split-leak", trained, [moved], [*database, FrameRef(trained, 5)]),
    ):
        with raises_user_error(code, contains):
            check_test(micro_store, test_queries, frames)


def test_a_counterfactual_of_a_scene_of_the_other_split_is_refused(micro_store) -> None:
    trained, tested = (micro_store.retrieval(split, "counterfactual")[0] for split in SPLITS)
    moved = replace(tested, target=trained.target)
    with raises_user_error("split-leak", trained.target.scene_id):
        check_test(micro_store, [moved], [trained.target])
    with raises_user_error("split-leak", tested.target.scene_id):
        check_training(micro_store, [replace(trained, target=tested.target)], 1)


@pytest.mark.parametrize("pool", POOLS)
def test_a_pool_without_queries_names_its_setting(micro_store, monkeypatch, pool) -> None:
    setting = {"future": "builders", "counterfactual": "counterfactual"}[pool]
    for split in SPLITS:
        assert read_queries(micro_store, split, pool) == micro_store.retrieval(split, pool)
    monkeypatch.setattr(Store, "retrieval", lambda *_: [])
    for split in SPLITS:
        with raises_user_error("missing-queries", (f"benchmark.retrieval.{setting}", split)):
            read_queries(micro_store, split, pool)
