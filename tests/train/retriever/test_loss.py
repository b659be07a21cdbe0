"""The retriever's loss, held against the library's for the same batch."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.losses import (
    CachedMultipleNegativesRankingLoss,
    MatryoshkaLoss,
)
from torch.nn.functional import cross_entropy, normalize

from conf.errors import UserError
from conf.schema import LoraConfig, RetrieverConfig
from data.records import FrameRef
from data.world.displacement import frame_displacements
from models.lora_kernels import fuse, unfuse
from models.retriever.embedder import frame_input, load_retriever, query_input, tokenizer_texts
from train.retriever.batches import batch_of
from train.retriever.inputs import RetrieverInputs
from train.retriever.loss import RankingLoss, early
from train.retriever.negatives import Weighing

SCALE = 20.0
NEGATIVES = 2
WEIGHTS = [1.0, 0.5]


@pytest.fixture(scope="module", params=["whole", "adapters"])
def trained(request, micro_store, retriever_cfg, saved_base, tmp_path_factory):
    """A retriever trained whole, and one with adapters over 4 bits that already do something."""
    cfg: RetrieverConfig = retriever_cfg
    if request.param == "adapters":
        over = {"architecture": None, "model": saved_base, "quantization": "nf4"}
        cfg = replace(cfg, **over, lora=LoraConfig(rank=4))
    texts = tokenizer_texts(micro_store.retrieval("train"), cfg)
    torch.manual_seed(0)
    model = load_retriever(cfg, "fp32", texts, tmp_path_factory.mktemp("base"))
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.05)
    return model.train(), cfg


@pytest.fixture(scope="module")
def library(trained, queries, frames) -> tuple[float, dict[str, torch.Tensor]]:
    """The library's own loss and gradients, on columns of its own inputs."""
    model, cfg = trained
    shown = [[q.target, *q.hard_negatives[:NEGATIVES]] for q in queries]
    columns = [
        model.preprocess(
            [query_input(q, frames, cfg) for q in queries], prompt=cfg.query_instruction
        )
    ] + [
        model.preprocess([frame_input(f, frames) for f in column], prompt=cfg.frame_instruction)
        for column in zip(*shown, strict=True)
    ]
    ranking = CachedMultipleNegativesRankingLoss(model, scale=SCALE, mini_batch_size=5)
    return gradients(model, MatryoshkaLoss(model, ranking, cfg.widths, WEIGHTS), columns)


def gradients(
    model: SentenceTransformer, loss: MatryoshkaLoss, features: list
) -> tuple[float, dict[str, torch.Tensor]]:
    model.zero_grad()
    found = loss(features, None)
    found.backward()
    trained = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    return found.item(), trained


def ours(trained, queries, frames, store, distinct=True, shared=True, **settings):
    model, cfg = trained
    settings = {"mini_batch": 5, "weighing": Weighing(store), "scale": SCALE, **settings}
    inputs = RetrieverInputs(model, frames, cfg, "fp32")
    loss = MatryoshkaLoss(model, RankingLoss(model, inputs, **settings), cfg.widths, WEIGHTS)
    fuse(model)
    try:
        return gradients(model, loss, [batch_of(queries, NEGATIVES, distinct, shared)])
    finally:
        unfuse(model)


def assert_same(one, two) -> None:
    assert one[0] == pytest.approx(two[0], rel=1e-5)
    assert one[1].keys() == two[1].keys()
    for name, gradient in two[1].items():
        apart = (one[1][name] - gradient).norm() / gradient.norm().clamp(min=1e-9)
        assert apart < 1e-4, (name, apart)


@pytest.mark.parametrize(
    "settings",
    [
        {"distinct": False, "shared": False},
        {"distinct": True, "shared": False},
        {"distinct": False, "shared": True},
        {"mini_batch": 1},
        {"mini_batch": 12},
        {"mini_batch_tokens": 400},
        {"ahead": 3},
    ],
    ids=str,
)
def test_gradients_are_the_librarys(
    trained, queries, frames, micro_store, library, settings
) -> None:
    assert_same(ours(trained, queries, frames, micro_store, **settings), library)


@pytest.mark.parametrize("trained", ["adapters"], indirect=True)
def test_features_of_a_frozen_tower_move_no_gradient(
    trained, queries, frames, micro_store, library
) -> None:
    assert_same(ours(trained, queries, frames, micro_store, reuse_features=True), library)


def test_bf16_moves_gradients_by_its_rounding_alone(
    micro_store, retriever_cfg, saved_base, queries, frames, tmp_path
) -> None:
    """As on GPUs: the base in bf16 and adapters in fp32, computed under autocast."""
    over = {"architecture": None, "model": saved_base, "lora": LoraConfig(rank=4)}
    cfg = replace(retriever_cfg, **over)
    losses, moved = {}, {}
    for precision in ("fp32", "bf16"):
        torch.manual_seed(0)
        model = load_retriever(cfg, precision, [], tmp_path).train()
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.data.normal_(std=0.05)
        inputs = RetrieverInputs(model, frames, cfg, precision)
        settings = {"mini_batch_tokens": 400, "reuse_features": True, "scale": SCALE}
        ranking = RankingLoss(
            model, inputs, weighing=Weighing(micro_store), mini_batch=5, **settings
        )
        loss = MatryoshkaLoss(model, ranking, cfg.widths, WEIGHTS)
        batch = batch_of(queries, NEGATIVES, distinct=True, shared=True)
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            losses[precision], found = gradients(model, loss, [batch])
        assert {gradient.dtype for gradient in found.values()} == {torch.float32}
        moved[precision] = torch.cat([gradient.flatten() for gradient in found.values()])
    assert losses["bf16"] == pytest.approx(losses["fp32"], rel=0.02)
    assert losses["bf16"] != losses["fp32"]
    assert torch.cosine_similarity(moved["bf16"], moved["fp32"], dim=0) > 0.98


def test_weights_that_are_all_one_change_nothing(
    trained, queries, frames, micro_store, library
) -> None:
    added = Weighing(micro_store, hard_weight=1 + 1e-12)
    assert_same(ours(trained, queries, frames, micro_store, weighing=added), library)


def scored(model, cfg, queries, frames, added) -> float:
    """The loss in closed form, from the embeddings that anyone gets."""
    batch = batch_of(queries, NEGATIVES, False, False)
    asked = model.encode(
        [query_input(q, frames, cfg) for q in queries],
        prompt=cfg.query_instruction,
        convert_to_tensor=True,
    )
    shown = model.encode(
        [frame_input(f, frames) for row in batch.documents() for f in row],
        prompt=cfg.frame_instruction,
        convert_to_tensor=True,
    )
    own = torch.arange(len(queries)) * (1 + NEGATIVES)
    total = 0.0
    for width, weight in zip(cfg.widths, WEIGHTS, strict=True):
        cut = [normalize(side[:, :width], dim=1) for side in (asked, shown)]
        total += weight * cross_entropy(cut[0] @ cut[1].T * SCALE + added.flatten(1), own).item()
    return total


@pytest.mark.parametrize("trained", ["whole"], indirect=True)
@pytest.mark.parametrize(
    "changes", [{"identical": True}, {"near": 20.0}, {"hard_weight": 3.0}], ids=str
)
def test_what_changes_the_objective_does_so_by_its_formula(
    trained, queries, frames, micro_store, library, changes
) -> None:
    model, cfg = trained
    weighing = Weighing(micro_store, **changes)
    loss, _ = ours(trained, queries, frames, micro_store, weighing=weighing, distinct=False)
    ordered = batch_of(queries, NEGATIVES, False, True).queries
    added = torch.tensor(
        [[[told(micro_store, q, o, f, j, changes) for j, f in enumerate(shown_of(o))]
          for o in ordered] for q in ordered]
    )  # fmt: skip
    model.eval()
    assert loss == pytest.approx(scored(model, cfg, ordered, frames, added), rel=1e-4)
    model.train()
    assert loss != pytest.approx(library[0], rel=1e-3)


def shown_of(query) -> list[FrameRef]:
    return [query.target, *query.hard_negatives[:NEGATIVES]]


def told(store, query, other, frame, place, changes) -> float:
    """What the settings' own words say is added to a score."""
    own = query is other
    if own and place == 0:
        return 0.0
    if changes.get("identical") and frame == query.target:
        return -math.inf
    if "near" in changes and frame.scene_id == query.target.scene_id:
        apart = frame_displacements(store.scene(frame.scene_id))[query.target.frame, frame.frame]
        if apart < changes["near"]:
            return -math.inf
    return math.log(changes.get("hard_weight", 1.0)) if own else 0.0


@pytest.mark.parametrize("ahead", [0, 1, 3, 20])
def test_what_is_made_early_comes_in_order_and_no_earlier_than_asked(ahead) -> None:
    made: list[int] = []

    def make(k: int) -> int:
        made.append(k)
        return k

    for k, given in enumerate(early(make, range(10), ahead)):
        assert given == k
        assert len(made) <= k + 1 + ahead + 1
    assert made == list(range(10))


@pytest.mark.parametrize("trained", ["whole"], indirect=True)
def test_an_embedding_that_is_no_number_is_named(trained, queries, frames, micro_store) -> None:
    model, _ = trained
    weight = next(model.parameters())
    kept = weight.data.clone()
    weight.data.fill_(math.nan)
    try:
        with pytest.raises(
            UserError, match=f"embedding of query {queries[0].query_id} is no number"
        ):
            ours(trained, queries, frames, micro_store)
    finally:
        weight.data.copy_(kept)
