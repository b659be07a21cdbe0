"""How the retriever's batches are composed."""

from __future__ import annotations

import pytest

from dynapix.train.retriever.batches import QueryBatchSampler, batch_columns


@pytest.fixture
def queries(micro_store):
    return micro_store.retrieval("train")


def epoch_batches(queries, batch=8, world_size=1, epoch=0) -> list[list[int]]:
    sampler = QueryBatchSampler(queries, 1, batch, seed=0, world_size=world_size)
    sampler.set_epoch(epoch)
    batches = list(sampler)
    assert len(batches) == len(sampler)
    return batches


def test_an_epoch_has_no_query_twice_and_full_batches(queries) -> None:
    batches = epoch_batches(queries)
    indices = [k for batch in batches for k in batch]
    assert len(set(indices)) == len(indices) == len(queries) // 8 * 8
    assert {len(batch) for batch in batches} == {8}


def test_batches_are_determined_by_seed_and_epoch(queries) -> None:
    assert epoch_batches(queries) == epoch_batches(queries)
    assert epoch_batches(queries) != epoch_batches(queries, epoch=1)


def test_ranks_share_the_batch_of_one_rank(queries) -> None:
    whole, parts = epoch_batches(queries), epoch_batches(queries, world_size=2)
    assert whole == [one + two for one, two in zip(parts[::2], parts[1::2], strict=True)]


def test_no_target_is_a_document_of_another_query_while_possible(queries) -> None:
    """In the small benchmark, queries share their scenes with others, and often their targets."""
    documents = [{q.target, *q.hard_negatives[:1]} for q in queries]
    first = epoch_batches(queries)[0]
    for k in first:
        for other in first:
            assert k == other or queries[k].target not in documents[other]


def test_incompatible_queries_fill_the_last_batches(queries) -> None:
    identical = [queries[0]] * 8
    batches = epoch_batches(identical, batch=4)
    assert sorted(k for batch in batches for k in batch) == list(range(8))


def test_columns_are_queries_targets_and_negatives(queries) -> None:
    columns = batch_columns(queries, 2)
    assert columns[0] == queries
    assert columns[1] == [q.target for q in queries]
    assert columns[2:] == [[q.hard_negatives[k] for q in queries] for k in range(2)]
