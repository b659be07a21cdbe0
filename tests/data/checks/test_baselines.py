"""Baselines of the retrieval track."""

from __future__ import annotations

import numpy as np
import pytest

from dynapix.data.checks.baselines import score_scene_alone
from dynapix.data.records import FrameRef
from dynapix.data.store import Store


def test_ranker_of_scenes_has_the_mean_of_random_orders(benchmark_store: Store) -> None:
    queries, database = benchmark_store.standard_test(), benchmark_store.database()
    rng, ranks = np.random.default_rng(0), []
    for _ in range(400):
        order = [database[k] for k in rng.permutation(len(database))]
        for query in queries:
            own = [f for f in order if f.scene_id == query.target.scene_id]
            ranks.append(own.index(query.target) + 1)
    found = score_scene_alone(queries, database)
    assert found["recall@1"] == pytest.approx(np.mean(np.array(ranks) <= 1), abs=0.01)
    assert found["recall@10"] == pytest.approx(np.mean(np.array(ranks) <= 10), abs=0.02)
    assert found["mrr"] == pytest.approx(np.mean(1 / np.array(ranks)), abs=0.01)


def test_denser_database_leaves_less_to_the_scene(benchmark_store: Store) -> None:
    """5 frames a scene give a recall@1 of 20%, the paper's 26 frames about 4%."""
    queries = benchmark_store.standard_test()
    for frames in (5, 26):
        database = [FrameRef(q.target.scene_id, k) for q in queries for k in range(frames)]
        database = [*dict.fromkeys(database)]
        found = score_scene_alone(queries, database)
        assert found["recall@1"] == pytest.approx(1 / frames)
        assert found["median rank"] == (frames + 1) / 2
