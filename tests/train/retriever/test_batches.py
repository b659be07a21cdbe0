"""How the retriever's batches are composed."""

from __future__ import annotations

from itertools import pairwise

import pytest

from train.retriever.batches import ORDERS, Batch, QueryBatchSampler, batch_of, prefix_of


@pytest.fixture
def queries(micro_store):
    return micro_store.retrieval("train")


def composed(queries, rule="random", batch=8, ranks=1, epoch=0, together=3) -> list[list[int]]:
    sampler = QueryBatchSampler(queries, 1, batch, rule, together, seed=0, ranks=ranks)
    sampler.set_epoch(epoch)
    made = list(sampler)
    assert len(made) == len(sampler)
    return made


def scenes(queries, batch) -> int:
    return len({queries[k].scene_id for k in batch})


@pytest.mark.parametrize("rule", ORDERS)
def test_an_epoch_has_no_query_twice_and_batches_of_one_size(queries, rule) -> None:
    made = composed(queries, rule)
    taken = [k for batch in made for k in batch]
    assert len(set(taken)) == len(taken) == len(queries) // 8 * 8
    assert {len(batch) for batch in made} == {8}


@pytest.mark.parametrize("rule", ORDERS)
def test_batches_follow_from_seed_and_epoch(queries, rule) -> None:
    assert composed(queries, rule) == composed(queries, rule)
    assert composed(queries, rule) != composed(queries, rule, epoch=1)


@pytest.mark.parametrize("rule", ORDERS)
def test_ranks_take_parts_of_the_one_batch(queries, rule) -> None:
    whole, parts = composed(queries, rule), composed(queries, rule, ranks=2)
    assert whole == [one + two for one, two in zip(parts[::2], parts[1::2], strict=True)]


@pytest.mark.parametrize("rule", ORDERS)
def test_a_target_is_shown_for_no_other_query_while_that_can_be(queries, rule) -> None:
    """Every query of the small benchmark shares its scene, and often its target, with others."""
    own = [{q.target, *q.hard_negatives[:1]} for q in queries]
    first = composed(queries, rule)[0]
    for k in first:
        for other in first:
            assert k == other or queries[k].target not in own[other]


def test_what_goes_with_nothing_fills_the_last_batches(queries) -> None:
    alike = [queries[0]] * 8
    assert sorted(k for batch in composed(alike, batch=4) for k in batch) == list(range(8))


def test_scenes_stand_together_or_apart_as_the_rule_says(queries) -> None:
    counts = {
        rule: sum(scenes(queries, batch) for batch in composed(queries, rule)) for rule in ORDERS
    }
    assert counts["scenes"] < counts["random"] < counts["spread"]


def same_columns(one: Batch, two: Batch) -> bool:
    named = [
        {q.query_id: shown for q, shown in zip(batch.queries, batch.documents(), strict=True)}
        for batch in (one, two)
    ]
    return named[0] == named[1]


@pytest.mark.parametrize("distinct", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_however_it_is_listed_a_batch_names_the_same(queries, distinct, shared) -> None:
    batch = batch_of(queries, 2, distinct, shared)
    assert same_columns(batch, batch_of(queries, 2, False, False))
    assert sum(batch.prefixes) == len(batch.queries) == len(queries)
    assert (len(set(batch.frames)) == len(batch.frames)) is distinct
    assert batch.columns.shape == (3, len(queries))
    prefixes = [prefix_of(q) for q in batch.queries]
    borders = sum(one != two for one, two in pairwise(prefixes))
    assert (borders + 1 == len(set(prefixes)) == len(batch.prefixes)) is shared
