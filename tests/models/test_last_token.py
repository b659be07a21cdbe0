"""A retriever's embeddings and gradients do not change with what its tower leaves out."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch

from dynapix.conf.schema import LateConfig, LoraConfig, RetrieverConfig
from dynapix.models.layers.attention import MATMUL
from dynapix.models.retriever import embedder
from dynapix.models.retriever.inputs import Retriever, model_inputs, preprocess
from dynapix.models.retriever.last_token import LastTokenTower, compute_last_token
from tests.tiny_models import (
    Gradients,
    assert_equal_gradients,
    collect_gradients,
    randomize_adapters,
)


@pytest.fixture(scope="module")
def cfg(retriever_cfg, saved_base) -> RetrieverConfig:
    return replace(retriever_cfg, architecture=None, model=saved_base, lora=LoraConfig(rank=4))


@pytest.fixture(scope="module")
def model(cfg, tmp_path_factory) -> Retriever:
    """A retriever as the libraries compute it, whose adapters have an effect."""
    torch.manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(embedder, "choose_computation", lambda *_: None)
        model = embedder.load_retriever(cfg, "fp32", [], tmp_path_factory.mktemp("base"))
    randomize_adapters(model, 0.1)
    return model.train()


@pytest.fixture
def fast(model) -> Retriever:
    """A copy that computes what the last token needs. It pads on the left all the same."""
    fast = copy.deepcopy(model)
    fast.tokenizer.padding_side = "right"
    compute_last_token(fast)
    return fast


def results(model: Retriever, inputs: dict[str, Any]) -> tuple[torch.Tensor, Gradients]:
    """Embeddings, and the gradients of a function of them."""
    model.zero_grad()
    embedded = model(dict(inputs))["sentence_embedding"]
    (embedded * torch.linspace(-1, 1, embedded.numel()).view_as(embedded)).sum().backward()
    return embedded.detach(), collect_gradients(model)


def assert_equal(found: tuple, expected: tuple) -> None:
    torch.testing.assert_close(found[0], expected[0], atol=1e-6, rtol=1e-5)
    assert_equal_gradients(found[1], expected[1])


@pytest.mark.parametrize("attention", ["sdpa", MATMUL])
@pytest.mark.parametrize("kind", ["queries", "one query", "frames", "texts"])
def test_embeddings_and_gradients_do_not_change(
    model, fast, cfg, queries, frames, attention, kind
) -> None:
    """The questions have several lengths, so that queries and texts are padded."""
    chosen = list({len(q.question): q for q in queries}.values())[:4]
    for each in (model, fast):
        each[0].model.set_attn_implementation({"text_config": attention, "vision_config": "sdpa"})
    if kind == "texts":
        texts = [q.question for q in chosen]
        expected = results(model, preprocess(model, texts, "query"))
        inputs = preprocess(fast, texts, "query")
    else:
        items = [q.target for q in chosen] if kind == "frames" else chosen
        items = items[:1] if kind == "one query" else items
        inputs = preprocess(model, *model_inputs(model, items, frames, cfg))
        expected = results(model, inputs)
    assert bool((inputs["attention_mask"] == 0).any()) is (kind in ("queries", "texts"))
    assert_equal(results(fast, inputs), expected)


def test_a_prompt_is_computed_once_and_the_last_mlp_for_one_token(
    fast, cfg, queries, frames
) -> None:
    tower, computed = fast[0].model.language_model, []
    for layer in tower.layers:
        layer.mlp.register_forward_pre_hook(lambda _, args: computed.append(args[0].shape[:2]))
    items = [q.target for q in queries[:4]]
    inputs = preprocess(fast, *model_inputs(fast, items, frames, cfg))
    expected = results(fast, inputs)
    tokens, vision = inputs["input_ids"], fast[0].model.config.vision_start_token_id
    # The prompt ends with the token that starts an image.
    prompt = int((tokens[0] == vision).nonzero()) + 1
    depth = len(tower.layers) - 1
    rest = (4, tokens.shape[1] - prompt)
    assert computed == [(1, prompt)] * depth + [(1, 1)] + [rest] * depth + [(4, 1)]
    # Recomputed activations take no cache, so that each input computes its prompt.
    fast[0].model.gradient_checkpointing_enable({"use_reentrant": False})
    assert_equal(results(fast, inputs), expected)


def test_a_model_with_many_vectors_computes_every_token(cfg, tmp_path) -> None:
    late = replace(cfg, late=LateConfig(width=24))
    model = embedder.load_retriever(late, "fp32", [], tmp_path)
    assert not isinstance(model[0].model.language_model, LastTokenTower)
