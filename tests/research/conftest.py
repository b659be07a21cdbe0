"""Samples of the tiny base, and a model that is deep enough for its targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import pytest

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.models.tiny_qwen3_vl import build_model
from dynapix.teacher.predicates.motion import find_cut
from research.tiny_base.collator import OracleCollator, letter_token_ids
from research.tiny_base.heads import OracleHeads
from research.tiny_base.oracle_targets import PICTURES
from research.tiny_base.samples import ItemSampler, OracleSample
from research.tiny_base.trace import CHOOSING
from research.tiny_base.training import first_token_ids
from tests.tiny_models import *  # noqa: F403
from tests.tiny_models import SMALL


@pytest.fixture(scope="session")
def items(micro_store: Store) -> list[SelectionItem]:
    return [
        item
        for item in micro_store.selection("train")
        if find_cut(micro_store.scene(item.scene_id), item.prefix_start, item.prefix_stop)
    ]


@pytest.fixture(scope="session")
def sampler(items: list[SelectionItem], frames: FrameReader) -> ItemSampler:
    return ItemSampler(items, frames, 6, seed=0)


@pytest.fixture(scope="session")
def ask(sampler: ItemSampler) -> Callable[..., list[OracleSample]]:
    """A function that asks a kind of question about the first items."""

    @cache
    def ask(kind: str, count: int) -> list[OracleSample]:
        return [sampler.make_sample(item, kind, "test") for item in sampler.items[:count]]

    return ask


@pytest.fixture(scope="session")
def collate(processor) -> OracleCollator:
    return OracleCollator(processor, 1500)


@pytest.fixture
def deep_model(processor):
    """A model with enough layers for all targets, and grouped-query attention."""
    sizes = replace(SMALL, layers=CHOOSING + 1, heads=PICTURES + 1, kv_heads=1)
    return build_model(sizes, len(processor.tokenizer)).eval()


@pytest.fixture
def heads(deep_model, processor) -> OracleHeads:
    words = first_token_ids(processor)
    kinds = {kind: words[kind] for kind in ("color", "material", "shape")}
    letters = letter_token_ids(processor.tokenizer)
    return OracleHeads(deep_model.get_input_embeddings(), kinds, letters)
