"""Samples of the tiny base, and a model that is deep enough for its targets."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.teacher.predicates.motion import find_cut
from research.tiny_base.collator import OracleCollator, letter_token_ids
from research.tiny_base.heads import OracleHeads
from research.tiny_base.oracle_targets import PICTURES
from research.tiny_base.samples import ItemSampler, OracleSample
from research.tiny_base.trace import CHOOSING
from research.tiny_base.training import first_token_ids
from tests.tiny_models import *  # noqa: F403


@pytest.fixture(scope="module")
def items(micro_store: Store) -> list[SelectionItem]:
    return [
        item
        for item in micro_store.selection("train")
        if find_cut(micro_store.scene(item.scene_id), item.prefix_start, item.prefix_stop)
    ]


@pytest.fixture(scope="module")
def sampler(items: list[SelectionItem], frames: FrameReader) -> ItemSampler:
    return ItemSampler(items, frames, 6, seed=0)


@pytest.fixture(scope="module")
def samples(sampler: ItemSampler) -> list[OracleSample]:
    return [sampler.make_sample(item, "compare", "test") for item in sampler.items[:3]]


@pytest.fixture
def collate(processor) -> OracleCollator:
    return OracleCollator(processor, 1500)


@pytest.fixture(params=[PICTURES + 1, 1], ids=["", "grouped"])
def deep_model(model, request: pytest.FixtureRequest):
    """A model with enough layers for all targets, without and with grouped-query attention."""
    from dynapix.models.tiny_qwen3_vl import build_model
    from tests.tiny_models import SMALL

    model = build_model(
        replace(SMALL, layers=CHOOSING + 1, heads=PICTURES + 1, kv_heads=request.param),
        model.config.text_config.vocab_size,
    )
    return model.eval()


@pytest.fixture
def heads(deep_model, processor) -> OracleHeads:
    words = first_token_ids(processor)
    kinds = {kind: words[kind] for kind in ("color", "material", "shape")}
    letters = letter_token_ids(processor.tokenizer)
    return OracleHeads(deep_model.get_input_embeddings(), kinds, letters)
