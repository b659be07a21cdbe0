"""A retriever is trained on the queries of one pool or of both."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dynapix.conf.entry import Run
from dynapix.conf.schema import ContrastiveTrainConfig
from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.store import Store
from dynapix.train import contrastive
from dynapix.train.common.held_out import held_out_scenes
from dynapix.train.retriever.batches import batch_columns, split_queries
from tests.user_errors import raises_user_error


@pytest.mark.parametrize("pools", [["future"], ["counterfactual"], [*POOLS]])
def test_queries_of_the_chosen_pools_are_split_by_scene(micro_store, pools) -> None:
    train = ContrastiveTrainConfig(pools=pools, batch=2, hold_out="future" in pools)
    training, validation = split_queries(micro_store, train, seed=0)
    queries = [q for pool in pools for q in micro_store.retrieval("train", pool)]
    held_out = held_out_scenes(micro_store) if train.hold_out else set()
    assert training == [q for q in queries if q.scene_id not in held_out]
    expected = {q.query_id for q in queries if q.scene_id in held_out or not held_out}
    assert {q.query_id for q in validation} == expected
    assert {q.pool for q in training} == set(pools)
    for query, first in zip(training, batch_columns(training, 1)[2], strict=True):
        assert first == (query.factual_twin or query.hard_negatives[0])


def test_a_pool_without_training_queries_is_refused(micro_store, monkeypatch) -> None:
    read = Store.retrieval
    monkeypatch.setattr(Store, "retrieval", lambda *a: [] if "counterfactual" in a else read(*a))
    train = ContrastiveTrainConfig(pools=[*POOLS], batch=2)
    with raises_user_error("missing-queries", "benchmark.retrieval.counterfactual"):
        split_queries(micro_store, train, seed=0)


def test_a_run_on_both_pools_is_evaluated_and_not_resumed_on_one(
    contrastive_settings, tmp_path
) -> None:
    train = replace(contrastive_settings.train, pools=[*POOLS], max_steps=1, evaluations=1)
    metrics = contrastive.main.__wrapped__(
        replace(contrastive_settings, train=train), Run("run", tmp_path)
    )
    assert {"recall@10", "recall@10_at_start"} <= set(metrics)
    other = replace(contrastive_settings, train=replace(train, pools=["future"]))
    (tmp_path / "metrics.json").unlink(missing_ok=True)
    with raises_user_error("other-data"):
        contrastive.main.__wrapped__(other, Run("run", tmp_path))


def test_pools_are_checked() -> None:
    for pools in ([], ["future", "future"], ["past"]):
        (problem,) = ContrastiveTrainConfig(pools=pools).check("train.")
        assert "train.pools" in problem
