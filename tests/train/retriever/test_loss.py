"""The retriever's loss and gradients equal those of the library on the same batch."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from sentence_transformers.multi_vector_encoder.losses import (
    CachedMultiVectorMultipleNegativesRankingLoss,
)
from sentence_transformers.sentence_transformer.losses import (
    CachedMultipleNegativesRankingLoss,
    MatryoshkaLoss,
)
from sentence_transformers.util.similarity import maxsim
from torch.nn.functional import cross_entropy, normalize
from torch.nn.utils.rnn import pad_sequence

from dynapix.conf.schema import LateConfig, LoraConfig, RetrieverConfig
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.models.retriever.embedder import load_retriever, tokenizer_texts
from dynapix.models.retriever.inputs import Retriever, embed, model_inputs
from dynapix.train.retriever.batches import batch_columns
from dynapix.train.retriever.inputs import RetrieverInputs
from dynapix.train.retriever.loss import RankingLoss, prefetched
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

NEGATIVES = 2
LATE = LateConfig(width=24)
Gradients = tuple[float, dict[str, torch.Tensor]]


def load(cfg: RetrieverConfig, precision: str, micro_store, folder) -> Retriever:
    """A retriever whose adapters, if any, have an effect."""
    # With the weights of seed 0, two tokens of a frame score so alike that rounding chooses the
    # greatest, and the gradient goes to one or the other.
    torch.manual_seed(1)
    texts = tokenizer_texts(micro_store.retrieval("train"), cfg)
    model = load_retriever(cfg, precision, texts, folder)
    randomize_adapters(model, 0.05)
    return model.train()


VARIANTS = {
    "whole": {},
    "adapters": {"quantization": "nf4", "lora": LoraConfig(rank=4)},
    "multi-vector": {"late": LATE},
    "multi-vector adapters": {"late": LATE, "lora": LoraConfig(rank=4)},
}


@pytest.fixture(scope="module", params=VARIANTS)
def trained(request, micro_store, retriever_cfg, saved_base, tmp_path_factory):
    changes = VARIANTS[request.param]
    if "lora" in changes:
        changes = changes | {"architecture": None, "model": saved_base}
    cfg = replace(retriever_cfg, **changes)
    return load(cfg, "fp32", micro_store, tmp_path_factory.mktemp("base")), cfg


@pytest.fixture(scope="module")
def distinct(queries):
    """Queries none of which has a target among the targets and hard negatives of another."""
    kept = []
    for query in queries:
        targets = {q.target for q in kept}
        documents = {f for q in kept for f in (q.target, *q.hard_negatives)}
        if query.target not in documents and not targets & {query.target, *query.hard_negatives}:
            kept.append(query)
    # More than the default mini-batch of `ranking_loss`.
    assert 3 < len(kept) <= 12
    return kept


def gradients(model, loss, features: list) -> Gradients:
    model.zero_grad()
    value = loss(features, None)
    value.backward()
    return value.item(), {
        n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None
    }


def scale(cfg: RetrieverConfig) -> float:
    return 20.0 if cfg.late is None else 0.5


def ranking_loss(model, inputs: RetrieverInputs, cfg: RetrieverConfig, **options) -> RankingLoss:
    widths = [cfg.late.width] if cfg.late else cfg.widths
    options = {"scale": scale(cfg), "mini_batch": 3, **options}
    return RankingLoss(model, inputs, widths=widths, **options)


@pytest.fixture(scope="module")
def library(trained, distinct, frames) -> Gradients:
    """The library's loss and gradients, computed with all inputs in memory."""
    model, cfg = trained
    features = []
    for column in batch_columns(distinct, NEGATIVES):
        inputs, kind = model_inputs(model, column, frames, cfg)
        features.append(model.preprocess(inputs, prompt=model.prompts[kind]))
    options = {"scale": scale(cfg), "mini_batch_size": 3}
    if cfg.late:
        loss = CachedMultiVectorMultipleNegativesRankingLoss(model, **options)
    else:
        ranking = CachedMultipleNegativesRankingLoss(model, **options)
        loss = MatryoshkaLoss(model, ranking, cfg.widths)
    return gradients(model, loss, features)


def own(trained, queries, frames, reuse_features=False, **options) -> Gradients:
    """Return the loss and gradients of `train.contrastive`, with its LoRA kernels."""
    model, cfg = copy.deepcopy(trained)
    use_fast_layers(model)
    inputs = RetrieverInputs(model, frames, cfg, bf16=False, reuse_features=reuse_features)
    loss = ranking_loss(model, inputs, cfg, **options)
    return gradients(model, loss, batch_columns(queries, NEGATIVES))


def assert_equal(one: Gradients, two: Gradients) -> None:
    assert one[0] == pytest.approx(two[0], rel=1e-5)
    assert one[1].keys() == two[1].keys()
    for name, gradient in two[1].items():
        difference = (one[1][name] - gradient).norm() / gradient.norm().clamp(min=1e-9)
        assert difference < 1e-4, (name, difference)


@pytest.mark.parametrize("options", [{}, {"mini_batch": 1}, {"mini_batch": 12}, {"prefetch": 2}])
def test_gradients_equal_the_librarys(trained, distinct, frames, library, options) -> None:
    assert_equal(own(trained, distinct, frames, **options), library)


@pytest.mark.parametrize("trained", ["adapters", "multi-vector adapters"], indirect=True)
def test_reused_vision_features_change_no_gradient(trained, distinct, frames, library) -> None:
    assert_equal(own(trained, distinct, frames, reuse_features=True), library)


@pytest.mark.parametrize("trained", ["adapters"], indirect=True)
@pytest.mark.parametrize(("mini_batch", "passes"), [(3, 2), (12, 1)])
def test_a_batch_within_one_mini_batch_is_embedded_once(
    trained, distinct, frames, monkeypatch, mini_batch, passes
) -> None:
    model, cfg = copy.deepcopy(trained)
    inputs = RetrieverInputs(model, frames, cfg, bf16=False, reuse_features=True)
    loss, columns = (
        ranking_loss(model, inputs, cfg, mini_batch=mini_batch),
        batch_columns(distinct, NEGATIVES),
    )
    embed_part, embedded = loss._embed, []

    def record(part, part_inputs):
        embedded.extend(part)
        return embed_part(part, part_inputs)

    monkeypatch.setattr(loss, "_embed", record)
    gradients(model, loss, columns)
    assert len(embedded) == passes * sum(map(len, columns))
    assert not inputs._kept


@pytest.mark.parametrize("trained", ["whole", "multi-vector"], indirect=True)
def test_the_loss_equals_its_formula_with_identical_frames_masked(
    trained, queries, distinct, frames
) -> None:
    """The formula is applied to the embeddings of `embed`. Some targets are documents of others."""
    model, cfg = trained
    assert len(queries) > len(distinct)
    value, _ = own(trained, queries, frames)
    documents = [f for q in queries for f in (q.target, *q.hard_negatives[:NEGATIVES])]
    vectors, document_vectors = (
        pad_sequence(embed(model, items, frames, cfg, 4), batch_first=True)
        for items in (queries, documents)
    )
    target = torch.arange(len(queries)) * (1 + NEGATIVES)
    masked = torch.zeros(len(queries), len(documents))
    for row, query in enumerate(queries):
        for column, frame in enumerate(documents):
            if frame == query.target and column != target[row]:
                masked[row, column] = -math.inf
    assert masked.isinf().any()
    expected = 0.0
    for width in [cfg.late.width] if cfg.late else cfg.widths:
        if cfg.late:
            scores = maxsim(vectors, document_vectors)
        else:
            rows, columns = (
                normalize(side[:, :width], dim=1) for side in (vectors, document_vectors)
            )
            scores = rows @ columns.T
        expected += cross_entropy(scores * scale(cfg) + masked, target).item()
    model.train()
    assert value == pytest.approx(expected, rel=1e-4)


def test_bf16_changes_gradients_by_rounding_only(
    micro_store, retriever_cfg, saved_base, queries, frames, tmp_path
) -> None:
    """As on GPUs, the base is in bf16 and the adapters in fp32, under autocast."""
    over = {"architecture": None, "model": saved_base, "lora": LoraConfig(rank=4)}
    cfg = replace(retriever_cfg, **over)
    losses, flat = {}, {}
    for precision in ("fp32", "bf16"):
        bf16 = precision == "bf16"
        model = load(cfg, precision, micro_store, tmp_path)
        inputs = RetrieverInputs(model, frames, cfg, bf16, reuse_features=True)
        loss = ranking_loss(model, inputs, cfg, mini_batch=5)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            losses[precision], computed = gradients(model, loss, batch_columns(queries, NEGATIVES))
        assert {gradient.dtype for gradient in computed.values()} == {torch.float32}
        flat[precision] = torch.cat([gradient.flatten() for gradient in computed.values()])
    assert losses["bf16"] == pytest.approx(losses["fp32"], rel=0.02)
    assert losses["bf16"] != losses["fp32"]
    assert torch.cosine_similarity(flat["bf16"], flat["fp32"], dim=0) > 0.98


@pytest.mark.parametrize("ahead", [0, 1, 3, 20])
def test_items_are_prefetched_in_order_and_within_the_limit(ahead) -> None:
    loaded: list[int] = []

    def load_one(k: int) -> int:
        loaded.append(k)
        return k

    for k, item in enumerate(prefetched(load_one, range(10), ahead)):
        assert item == k
        assert len(loaded) <= k + 1 + ahead + 1
    assert loaded == list(range(10))


@pytest.mark.parametrize("trained", ["whole"], indirect=True)
def test_a_non_finite_embedding_is_named(trained, queries, frames) -> None:
    model, _ = trained
    weight = next(model.parameters())
    kept = weight.data.clone()
    weight.data.fill_(math.nan)
    try:
        with raises_user_error("non-finite-embedding", queries[0].query_id):
            own(trained, queries, frames)
    finally:
        weight.data.copy_(kept)
